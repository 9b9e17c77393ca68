"""Conformance of the simulated arm and the dVRK console: the same checks of topics, states and commands."""

import pytest
from crtk_conformance import compare
from ros_publisher import DOMAIN_FILE

pytest.importorskip("cyclonedds", reason="needs cyclonedds")

pytestmark = [pytest.mark.network, pytest.mark.realtime, pytest.mark.slow]

#: Checks in which the arms differ on purpose (docs/ros.md): beginnings of the texts of the console and the simulation.
DIFFERENCES = {
    "servo_jp with a number too many": ("set-point [", "set-point unchanged"),
    "servo_jp with a jump of 70 mm": ("FAULT, homed", "ENABLED, homed"),
    "pause, pause, resume": ("PAUSED, homed", "ENABLED, homed"),
    "unhome, then home": ("ENABLED, not homed", "ENABLED, homed"),
}


@pytest.mark.parametrize("arm", ["MTML", "PSM1"])
def test_simulated_arm_conforms_to_the_console(arm, tmp_path, monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    found = compare(arm, tmp_path)
    different = {check: texts for check, texts in found.items() if texts[0] != texts[1]}
    assert different.keys() == DIFFERENCES.keys() & found.keys(), different
    for check, texts in different.items():
        for text, beginning in zip(texts, DIFFERENCES[check], strict=True):
            assert text.startswith(beginning), check
