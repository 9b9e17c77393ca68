"""Releases of a simulated arm with all effects, under gravity compensation alone and in mode "guide".

    python benchmarks/calibrated_releases.py CALIBRATION [--releases 200] [--modes gravity guide] [--processes 2]

CALIBRATION is a folder of `dvrk-drake calibrate`, or the name of an arm. The arm is released at random poses and moves
freely for 10 s. A release passes if no joint is ever further than 15 mrad (1.5 mm for the insertion) or five encoder
counts from its release pose. An encoder count of the wrist roll of an MTM is 6 mrad. The arm is released at rest, after
the controller moved it to the pose by 0.2 rad (20 mm) in all joints, or after a hand led it along this motion for 3 s,
rested for 0.5 s and let go. These motions load the friction.

The models are static.yaml and model.yaml of the calibration, the exact model, and the exact model with all masses
20 % larger. In the last two models, the cross-validated error is the RMS error of the model at the poses, as `validate`
would measure it. Poses at which the exact holding effort exceeds the limit of a motor are omitted, because no model can
hold the arm there.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput
from pydrake.trajectories import PiecewisePolynomial
from timing import print_table

import dvrk_drake as dvrk
from dvrk_drake.experiments.releases import BAND, DURATION, SAMPLE_PERIOD, approach_start, release
from dvrk_drake.experiments.simulation import samples

APPROACHES = {"none": "at rest", "regulated": "after an approach", "hand": "after a hand"}

#: Duration of the motion that a hand leads, and rest before it lets go [s].
HAND_TIME, HAND_REST = 3.0, 0.5

#: Ratios of the stiffness and damping of a hand that leads an arm to the gains of the arm. The hand follows its path
#: within about 0.01 rad against the friction of the arm, and a larger damping would be unstable at 1 kHz.
HAND_STIFFNESS, HAND_DAMPING = 10.0, 3.0

#: Factor of the base parameters in the wrong model.
WRONG = 1.2

#: Encoder counts by which a held joint may move. The controller does not notice a smaller motion in time.
COUNTS = 5.0


class JointHand(LeafSystem):
    """Hand that leads each joint of an arm along a trajectory with a spring and a damper, and lets go at a time [s]."""

    def __init__(self, arm, trajectory, release_time):
        super().__init__()
        self._trajectory, self._velocity = trajectory, trajectory.MakeDerivative()
        self._stiffness, self._damping = HAND_STIFFNESS * np.array(arm.gains.kp), HAND_DAMPING * np.array(arm.gains.kd)
        self._release_time = release_time
        self.DeclareVectorInputPort("state_estimated", 2 * arm.num_joints)
        self.DeclareVectorOutputPort("effort_disturbance", arm.num_joints, self._calc_effort)

    def _calc_effort(self, context, output):
        time = min(context.get_time(), self._trajectory.end_time())
        if context.get_time() >= self._release_time:
            output.SetZero()
            return
        q, v = np.split(self.get_input_port().Eval(context), 2)
        error, error_rate = self._trajectory.value(time).ravel() - q, self._velocity.value(time).ravel() - v
        output.SetFromVector(self._stiffness * error + self._damping * error_rate)


def release_by_hand(arm, model, pose, mode, duration, seed):
    """Simulates a hand that leads the arm to a pose and lets go; returns the positions (samples, n) after that."""
    name, release_time = arm.name.lower(), HAND_TIME + HAND_REST
    knots = np.column_stack([approach_start(arm, pose, seed), pose])
    trajectory = PiecewisePolynomial.CubicHermite([0.0, HAND_TIME], knots, np.zeros_like(knots))
    builder = DiagramBuilder()
    station = dvrk.ArmStation(arm, effects=arm.effects, seed=seed)
    dvrk.add_closed_loop(builder, station, dvrk.GravityPidController(model, mode=mode))
    hand = builder.AddSystem(JointHand(arm, trajectory, release_time))
    builder.Connect(station.GetOutputPort(f"{name}.state_true"), hand.get_input_port())
    builder.Connect(hand.get_output_port(), station.GetInputPort(f"{name}.effort_disturbance"))
    log = LogVectorOutput(station.GetOutputPort(f"{name}.state_true"), builder, SAMPLE_PERIOD)
    simulator = Simulator(builder.Build())
    station.SetPositions(station.GetMyMutableContextFromRoot(simulator.get_mutable_context()), knots[:, 0])
    simulator.AdvanceTo(release_time + duration)
    return samples(log, simulator)[round(release_time / SAMPLE_PERIOD) :, : arm.num_joints]


def one_release(arm, path, pose, mode, approach, duration, seed):
    """Returns the positions (samples, n) of an arm with the model file `path` after a release."""
    model = load_model(path)
    if approach == "hand":
        return release_by_hand(arm, model, pose, mode, duration, seed)
    return release(arm, model, pose, mode=mode, approach=approach == "regulated", duration=duration, seed=seed)


@cache
def load_model(path):
    """Returns the model of a file. Each process reads it once."""
    return dvrk.IdentifiedModel.load(path)


def with_error(model, true, factor, q):
    """Returns `model` with base parameters times a factor, and with its RMS error at the poses q in its statistics."""
    wrong = [replace(parameter, value=factor * parameter.value) for parameter in model.base_parameters]
    changed = replace(model, base_parameters=wrong)
    errors = np.sqrt(np.mean((changed.holding_torque(q) - true.holding_torque(q)) ** 2, axis=0))
    joints = [
        replace(joint, rms_cross_validation_included=float(max(error, 1e-9)))
        for joint, error in zip(model.joints, errors, strict=True)
    ]
    return replace(changed, joints=joints)


def main() -> None:
    """Prints a table of the releases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calibration", type=Path, help="folder of a calibration, or name of an arm")
    parser.add_argument("--releases", type=int, default=200, help="number of releases; default: %(default)s")
    parser.add_argument("--models", nargs="+", help="static, model, exact, wrong; default: all that exist")
    parser.add_argument("--modes", nargs="+", default=["gravity", "guide"], help="modes; default: %(default)s")
    parser.add_argument("--approaches", nargs="+", default=list(APPROACHES), help="approaches; default: %(default)s")
    parser.add_argument("--duration", type=float, default=DURATION, help="simulated time [s]; default: %(default)s")
    parser.add_argument("--processes", type=int, help="number of processes; default: number of cores")
    parser.add_argument("--seed", type=int, default=12345, help="seed of the poses; default: %(default)s")
    options = parser.parse_args()
    is_calibrated = options.calibration.is_dir()
    if is_calibrated:
        arm = dvrk.IdentifiedModel.load(options.calibration / "static.yaml").arm
    else:
        arm = dvrk.load_arm(str(options.calibration))
    true = dvrk.IdentifiedModel.from_arm(arm, arm.effects.position_dependent)
    sampled = arm.sample_poses(4 * options.releases, np.random.default_rng(options.seed), margin=0.05)
    can_hold = np.all(np.abs(true.holding_torque(sampled)) <= arm.effort_limits, axis=1)
    poses = sampled[can_hold][: options.releases]
    print(f"{100 * np.mean(~can_hold):.0f} % of the poses are omitted, because a motor is too weak")
    band = np.maximum(arm.per_joint(*BAND), COUNTS * arm.encoder_counts())
    unit = np.where(arm.prismatic, 1e4, 1e3)
    rows = {}
    with ProcessPoolExecutor(options.processes) as executor, TemporaryDirectory() as folder:
        for name, factor in (("exact", 1.0), ("wrong", WRONG)):
            with_error(true, true, factor, poses).save(Path(folder) / f"{name}.yaml")
        for name in options.models or [*(["static", "model"] if is_calibrated else []), "exact", "wrong"]:
            path = (Path(folder) if name in ("exact", "wrong") else options.calibration) / f"{name}.yaml"
            for mode in options.modes:
                for approach in options.approaches:
                    more = mode, approach, options.duration
                    cases = [executor.submit(one_release, arm, path, q, *more, k) for k, q in enumerate(poses)]
                    positions = np.array([case.result() for case in cases])
                    largest = np.abs(positions - positions[:, :1]).max(axis=1)
                    held = np.all(largest <= band, axis=1)
                    ripple = np.ptp(positions[:, -50:], axis=1).max(axis=0)  # in the last second
                    rows[f"{name}, {mode}, {APPROACHES[approach]}"] = [
                        f"{np.count_nonzero(held)} of {len(cases)}",
                        f"{15 * np.median((largest / band).max(axis=1)):.1f}",
                        *(f"{x:.1f}" for x in unit * largest.max(axis=0)),
                        f"{(unit * ripple).max():.2f}",
                    ]
                    print(f"{name}, {mode}, {APPROACHES[approach]}:", *rows[f"{name}, {mode}, {APPROACHES[approach]}"])
    headings = [
        "held",
        "median of the largest joint [1/15 of the band]",
        *(f"{name} [{'0.1 mm' if p else 'mrad'}]" for name, p in zip(arm.joint_names, arm.prismatic, strict=True)),
        "largest motion in the last second [mrad, 0.1 mm]",
    ]
    print_table(f"{arm.name}: releases, and largest distance of each joint from its release pose", headings, rows)


if __name__ == "__main__":
    main()
