"""Commands that neither simulate nor draw start without the modules that take time to import."""

import subprocess
import sys


def test_text_of_a_model_needs_neither_a_simulation_nor_a_plot():
    modules = ("identification", "payload", "recording_check", "export", "model")
    statement = f"import sys; from dvrk_drake.reports import {', '.join(modules)}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", statement], capture_output=True, text=True, check=True)
    loaded = done.stdout.split()
    assert "dvrk_drake.reports.identification" in loaded
    assert not [
        name
        for name in loaded
        if name in ("matplotlib", "scipy.signal", "scipy.stats") or name.startswith("dvrk_drake.experiments")
    ]
