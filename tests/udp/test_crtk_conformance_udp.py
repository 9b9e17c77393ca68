"""Conformance of the simulated arm and the dVRK console: the same checks of topics, states and commands."""

import pytest
from crtk_conformance import observe, start
from own_network import inside, outside, run_inside
from ros_publisher import DOMAIN_FILE

from dvrk_drake.models.arm_files import load_arm

pytest.importorskip("cyclonedds", reason="needs cyclonedds")

#: Checks in which the simulated arm differs from the console on purpose, with the observed texts.
DIFFERENCES = {
    # A dVRK executes the first n numbers.
    "servo_jp with a number too many": ("moved", "not moved"),
}


@outside
def test_runs_in_a_separate_network(request):
    run_inside(request)


@inside
@pytest.mark.parametrize(("arm", "motion"), [("MTML", False), ("MTML", True), ("PSM1", True)])
def test_simulated_arm_conforms_to_the_console(arm, motion, tmp_path, monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    found = {}
    for kind in ("console", "simulated"):
        with start(kind, arm, tmp_path, motion=motion) as subject:
            found[kind] = observe(subject, load_arm(arm.rstrip("1").lower()), motion=motion)
    assert found["console"].keys() == found["simulated"].keys()
    for check, text in found["console"].items():
        expected, own = DIFFERENCES.get(check, (text, text))
        assert text.startswith(expected), check
        assert found["simulated"][check].startswith(own), check
