"""Next step that `dvrk-drake check` suggests for a recording of another arm."""

import numpy as np
from command_output import messages

from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.recordings.writing import write_recording

MTML = load_arm("mtml")


def check(capsys, folder, wrist, arm, *options):
    """Checks poses of an MTML, one of them with another position of wrist_platform, as a recording of `arm`.

    Returns the next step, and the message on stderr.
    """
    q, path = MTML.sample_poses(30, np.random.default_rng(5)), folder / "r.csv"
    q[:, [0, 3]] *= 0.4  # within the limits of both MTMs
    q[3, 3] = wrist
    write_recording(Recording(q=q, tau=IdentifiedModel.from_arm(MTML).holding_torque(q)), path)
    assert main(["check", str(path), "--arm", arm, *options]) == 2
    captured = capsys.readouterr()
    (step,) = (line for line in captured.out.splitlines() if line.startswith("Next: "))
    (error,) = messages(captured.err)
    return step.removeprefix("Next: dvrk-drake check ").replace(str(path), "r.csv"), error


def test_next_step_is_the_check_for_the_other_arm(tmp_path, capsys):
    # This position is within the limits of an MTML, and 1.8 rad outside those of an MTMR.
    step, error = check(capsys, tmp_path, -3.5, "mtmr", "--coordinates", "joint")
    assert (
        "Is the arm or the choice of coordinates wrong? Coordinates: joint, actuator, or wpi (recordings of WPI"
        in error
    )
    assert step == "r.csv --arm mtml --coordinates joint"


def test_next_step_names_no_arm_if_several_fit(tmp_path, capsys):
    assert check(capsys, tmp_path, 0.0, "psm")[0] == "r.csv --arm ARM"


def test_a_recording_of_no_arm_is_checked_again(tmp_path, capsys):
    """The cause is in the file, which the user corrects."""
    assert check(capsys, tmp_path, 6.0, "mtmr")[0] == "r.csv --arm mtmr"
