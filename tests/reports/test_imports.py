"""Reports without simulations and plots do not import the slow modules for these."""

import subprocess
import sys


def test_reports_import_no_simulation_and_no_plots():
    modules = ("identification", "payload", "recording_check", "export", "parameters")
    statement = f"import sys; from dvrk_drake.reports import {', '.join(modules)}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", statement], capture_output=True, text=True, check=True)
    loaded = done.stdout.split()
    assert "dvrk_drake.reports.identification" in loaded
    assert not [
        name
        for name in loaded
        if name in ("matplotlib", "scipy.signal", "scipy.stats") or name.startswith("dvrk_drake.experiments")
    ]
