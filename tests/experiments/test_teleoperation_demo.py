"""Teleoperation demo of a master and a PSM: simulated hand, live controls, command."""

from functools import partial

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from dvrk_drake.cli import main
from dvrk_drake.experiments.teleoperation import SCALE, play_teleoperation, run_live_teleoperation, start_scene


@pytest.mark.slow
def test_tip_follows_hand_within_half_a_millimetre():
    shares = []
    meshcat = start_scene()
    result = play_teleoperation(meshcat, progress=shares.append)
    assert shares[-1] == 1.0
    assert result.handle_path > 0.5
    assert result.max_position_error < 5e-4
    assert result.max_rotation_error < 5e-3
    assert result.max_motion_held < 5e-5
    assert meshcat.HasPath("/drake/mtml/links")
    assert meshcat.HasPath("/drake/mtml/path/1")
    assert meshcat.HasPath("/drake/psm/path/1")
    assert "path" in meshcat.StaticHtml()


def pressed(name):
    """Returns the message of the browser for a pressed button: msgpack of {type: button, name: name}."""
    text = [bytes([0xA0 + len(word)]) + word.encode() for word in ("type", "button", "name", name)]
    return b"\x82" + b"".join(text)


def test_live_scene_responds_to_sliders_and_buttons(monkeypatch):
    meshcat = start_scene()
    plan = {  # time [s]: what the user does
        0.1: lambda: meshcat.SetSliderValue("hand_z", 0.05),
        1.1: lambda: meshcat._InjectWebsocketMessage(pressed("Clutch")),
        1.3: lambda: meshcat.SetSliderValue("hand_z", 0.0),
        2.1: lambda: meshcat.SetSliderValue("scale", 0.9),
        2.2: lambda: meshcat.SetSliderValue("hand_x", 0.05),
        3.4: lambda: meshcat._InjectWebsocketMessage(pressed("Clutch")),
        3.5: lambda: meshcat.SetSliderValue("hand_x", 0.0),
        4.0: lambda: meshcat._InjectWebsocketMessage(pressed("Stop")),
    }
    tips = {}

    class Watched(Simulator):
        def AdvanceTo(self, time):
            arms = self.get_system()
            self.set_target_realtime_rate(0.0)
            for due in [due for due in plan if due <= time]:
                tips[due] = arms.CalcX_FT(self.get_context()).translation()
                plan.pop(due)()
            super().AdvanceTo(time)

    monkeypatch.setattr("dvrk_drake.experiments.teleoperation.Simulator", Watched)
    run_live_teleoperation(meshcat, duration=10.0)
    assert not plan
    np.testing.assert_allclose(tips[1.3], tips[0.1], atol=1e-5)  # open, then closed at rest
    np.testing.assert_allclose(tips[2.1] - tips[1.3], [0, 0, -SCALE * 0.05], atol=3e-4)
    np.testing.assert_allclose(tips[3.4] - tips[2.2], [0.9 * 0.05, 0, 0], atol=3e-4)
    np.testing.assert_allclose(tips[4.0], tips[3.5], atol=3e-4)


def test_cli_writes_recording_and_errors(tmp_path, monkeypatch, capsys):
    short = partial(play_teleoperation, duration=0.6)
    monkeypatch.setattr("dvrk_drake.experiments.teleoperation.play_teleoperation", short)
    page = tmp_path / "teleop.html"
    assert main(["simulate", "teleop", "--output", str(page)]) == 0
    assert "<html" in page.read_text()
    assert "position [mm]" in capsys.readouterr().out


def test_cli_rejects_invalid_port(capsys):
    assert main(["simulate", "teleop", "--port", "80"]) == 2
    assert "port 80 cannot be opened" in capsys.readouterr().err
