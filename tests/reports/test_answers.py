"""Pages in a terminal: answer, next step, then tables of at most 80 columns."""

import os
import re
import shlex
import tempfile
from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from loaded_arm import two_days
from report_results import operator_forces, study_results, tuning_result

import dvrk_drake as dvrk
from dvrk_drake.cli.program import app
from dvrk_drake.dynamics.symbolic_gravity import derive_gravity
from dvrk_drake.experiments.demo import DemoResult
from dvrk_drake.experiments.teleoperation import TeleoperationResult
from dvrk_drake.export.dvrk_mtm_gravity_compensation import compare_compensation
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
from dvrk_drake.reports import demo, export, recording_check, simulation, terminal
from dvrk_drake.reports.identification import identification_page, recalibration_page
from dvrk_drake.reports.parameters import symbolic_model_page
from dvrk_drake.reports.payload import payload_page
from dvrk_drake.reports.study import study_page
from dvrk_drake.reports.terminal import TABLE_WIDTH, TableConsole
from dvrk_drake.reports.transparency import transparency_page
from dvrk_drake.reports.tuning import tuning_page

pytestmark = pytest.mark.slow


@cache
def poses():
    """Returns a static identification, and its validation on poses with wrong efforts of one joint."""
    arm, recordings, generator = dvrk.load_arm("mtml"), [], np.random.default_rng(0)
    for _ in range(2):
        q = arm.sample_poses(40, generator)
        tau = dvrk.IdentifiedModel.from_arm(arm).holding_torque(q)
        tau += 0.003 * arm.effort_limits * generator.normal(size=q.shape)
        recordings.append(dvrk.Recording(q=q, tau=tau, source="poses.csv"))
    recordings[0].tau[:3, 1] += 1.0  # outliers
    recordings[1].tau[:, 2] *= 0.3
    identified = dvrk.identify(recordings[0], arm)
    return identified, dvrk.validate(identified.model, recordings[1])


@cache
def motions():
    """Returns two recordings of a motion, without and with a payload, and the identification of the first."""
    _, reference, loaded = two_days("psm", "end_link", 0.2, [0.02, 0.02, 0.39], 0)
    return reference, loaded, dvrk.identify(reference, dvrk.load_arm("psm"))


@cache
def payloads():
    reference, loaded, identified = motions()
    return dvrk.payload(reference, loaded, identified.model)


def on_insertion_link(found):
    named = next(one for one in found.estimates if one.link == "insertion_link")
    return replace(found, payload=named, link=named.link)


def exported(console, verbose, model, name, **options):
    with tempfile.TemporaryDirectory() as folder:
        before = os.getcwd()
        os.chdir(folder)
        try:
            written = dvrk.export_model(model, name, origin="model.yaml", **options)
            print_page(console, export.export_page(name, written), verbose=verbose)
        finally:
            os.chdir(before)


def compared(console, verbose):
    identified = poses()[0].model
    with tempfile.TemporaryDirectory() as folder:
        dvrk.export_model(identified, f"{folder}/gc.json", "dvrk-gc", tolerance=1.0)
        file = GravityCompensationFile.load(f"{folder}/gc.json")
    file.torque_upper[1] = 0.3
    found = compare_compensation(file, identified)
    page = export.compensation_page(found, file_name="gc.json", model_name="model.yaml")
    print_page(console, page, verbose=verbose)


def checked(console, verbose, **changes):
    reference = motions()[0]
    report = dvrk.check(replace(reference, **changes), dvrk.load_arm("psm"))
    print_page(console, recording_check.check_page(report, source="--arm psm"), verbose=verbose)


def simulated(console, verbose, settings):
    scenario = dvrk.load_scenario("psm", ["duration=0.1", *settings])
    page = simulation.simulation_page(
        dvrk.simulate(scenario), scenario.mounted_arm, next_step="dvrk-drake simulate psm"
    )
    print_page(console, page, verbose=verbose)


def demonstrated(console, verbose):
    identified, validation = poses()
    t = np.arange(3.0)
    q = np.outer(t, np.ones(7))
    arm, shown = identified.model.arm, {"time": t, "identified": 0.005 * q, "nominal": 0.5 * q}
    result = DemoResult(arm=arm, identification=identified, fresh=validation, fresh_nominal=validation, **shown)
    print_page(console, demo.demo_page(result, Path("demo_output")), verbose=verbose)


NEXT_STEPS = []


def print_page(console, page, *, verbose=False):
    NEXT_STEPS.append(page.next_step)
    terminal.print_page(console, page, verbose=verbose)


VERDICT = r"Verdict: (good|usable|do not use) ?[(.]"
#: Mapping from a case to a pattern for the start of the answer, and the function that prints it.
CASES = {
    "identify poses": (VERDICT, lambda c, v: print_page(c, identification_page(poses()[0]), verbose=v)),
    "identify motion": (VERDICT, lambda c, v: print_page(c, identification_page(motions()[2]), verbose=v)),
    "validate poses": (
        r"Verdict: do not use \(elbow_pitch\)\. Largest error: \d+\.\d % of the effort limit",
        lambda c, v: print_page(c, identification_page(poses()[1]), verbose=v),
    ),
    "validate motion": (
        VERDICT,
        lambda c, v: print_page(c, identification_page(dvrk.validate(motions()[2].model, motions()[1])), verbose=v),
    ),
    "recalibrate": (
        r"Mean effort error \d+\.\d % before and \d+\.\d % after the refit",
        lambda c, v: print_page(c, recalibration_page(dvrk.recalibrate(motions()[2].model, motions()[1])), verbose=v),
    ),
    "check": (r"Verdict: usable", checked),
    "check, refused": (r"Verdict: unusable \(wrong time\)\.", lambda c, v: checked(c, v, t=1000 * motions()[0].t)),
    "payload": (
        r"Payload: 0\.\d{4} kg on \w+ \(95 % interval 0\.\d{4}\.\.0\.\d{4} kg\)\.",
        lambda c, v: print_page(c, payload_page(payloads()), verbose=v),
    ),
    "payload, none": (
        r"No payload found on insertion_link",
        lambda c, v: print_page(c, payload_page(on_insertion_link(payloads()), model_path="m.yaml"), verbose=v),
    ),
    "export SDF": (r"\d+ links differ", lambda c, v: exported(c, v, poses()[0].model, "out.sdf")),
    "export URDF": (r"\d+ links differ", lambda c, v: exported(c, v, motions()[2].model, "out.urdf")),
    "export dVRK, MTM": (
        r"The file differs from the model by at most \d+\.\d % of the effort limit \(\w+, 0\.\d+ N m\)",
        lambda c, v: exported(c, v, poses()[0].model, "gc.json", format="dvrk-gc", tolerance=1.0),
    ),
    "export dVRK, PSM": (
        r"The torques of the file and the model are equal at rest",
        lambda c, v: exported(
            c, v, dvrk.IdentifiedModel.from_arm(dvrk.load_arm("psm")), "psm.json", format="dvrk-kinematic-gc"
        ),
    ),
    "compare-gc": (
        r"Largest difference between file and model: \d\.\d{3} N m \(\w+\)\. "
        r"Poses with a torque at limit, runaway or opposed: [1-9][\d.]* %",
        compared,
    ),
    "simulate, hold": (r"Largest tracking error .*: \S+ \w+ \(\w+, \S+ %", lambda c, v: simulated(c, v, [])),
    "simulate, gravity": (
        r"Largest motion from the start .*: \S+ \w+ \(\w+, \S+ %",
        lambda c, v: simulated(c, v, ["controller.mode=gravity"]),
    ),
    "study": (
        r"held exact: \d+ of 12 runs; another one: \d+ of 12 runs\.",
        lambda c, v: print_page(c, study_page(*study_results(), study_path="s"), verbose=v),
    ),
    "tune": (
        r"Gains of method model are better than the arm's own: ",
        lambda c, v: print_page(c, tuning_page(tuning_result()), verbose=v),
    ),
    "transparency": (
        r"Smallest interaction force at the handle: \d+\.\d\d N RMS with model A, friction 0\.5",
        lambda c, v: print_page(c, transparency_page(*operator_forces()), verbose=v),
    ),
    "demo": (
        "Verdict: in mode guide, the identified model holds the released MTML for 2 s. Largest drift: 10.0 mrad",
        demonstrated,
    ),
    "teleop": (
        r"The tip follows the handle within 0\.500 mm",
        lambda c, v: print_page(
            c, demo.teleoperation_page(TeleoperationResult(1.2, 1e-4, 5e-4, 1e-3, 2e-3, 1e-6), "page.html"), verbose=v
        ),
    ),
    "model": (
        r"The gravity torque of MTML depends on 12 base parameters\.",
        lambda c, v: print_page(c, symbolic_model_page(derive_gravity(dvrk.load_arm("mtml"))), verbose=v),
    ),
}


def printed(case, verbose):
    console = TableConsole(file=StringIO(), highlight=False, width=TABLE_WIDTH)
    CASES[case][1](console, verbose)
    return console.file.getvalue()


@pytest.mark.parametrize("case", CASES)
def test_answer_comes_first_and_output_fits_80_columns(case):
    short, whole = printed(case, False), printed(case, True)
    for text in (short, whole):
        answer, _, _ = text.partition("\n\n")
        assert re.match(CASES[case][0], " ".join(answer.split())), text
        assert answer.count("\n") < 3
        # Findings are not wrapped, so that they can be searched.
        lines = [line for line in text.splitlines() if not line.startswith(("warning: ", "note: "))]
        assert max(len(line.rstrip()) for line in lines) <= 80, text
        assert "…" not in text
    assert whole.startswith(short.split("\n\n")[0]) and len(whole) >= len(short)
    if (step := NEXT_STEPS.pop()).startswith("dvrk-drake "):
        app.parse_args(shlex.split(step)[1:], print_error=False, exit_on_error=False)
