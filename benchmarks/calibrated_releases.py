"""Releases of a simulated arm with all effects, under gravity compensation alone and in mode "guide".

    python benchmarks/calibrated_releases.py CALIBRATION [--releases 200] [--modes gravity guide] [--processes 2]

CALIBRATION is a folder of `dvrk-drake calibrate`, or the name of an arm. The arm is released at random poses and moves
freely for 3 s. A release passes if no joint is ever further than 15 mrad (1.5 mm for the insertion) or five encoder
counts from its release pose. An encoder count of the wrist roll of an MTM is 6 mrad. The arm is released at rest, after
the controller moved it to the pose by 0.2 rad (20 mm) in all joints, or after a hand led it along this motion for 3 s,
rested for 0.5 s and let go. These motions load the friction. The hand is compliant, trembles and drifts.

The models are static.yaml and model.yaml of the calibration, the exact model, the exact model with all masses 20 %
larger, and a model that is identified from one simulated motion that was designed for it. In the exact and the wrong
model, the cross-validated error is the RMS error of the model at the poses, as `validate` would measure it. The model
from a motion states the error of the efforts in motion. Poses at which the exact
holding effort exceeds the limit of a motor are omitted, because no model can hold the arm there.
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
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from timing import print_table

import dvrk_drake as dvrk
from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.experiments.releases import BAND, SAMPLE_PERIOD, approach_start, release
from dvrk_drake.experiments.simulation import samples
from dvrk_drake.systems.hand import Grip

APPROACHES = {"none": "at rest", "regulated": "after an approach", "hand": "after a hand"}

#: Duration of the motion that a hand leads, and rest before it lets go [s].
HAND_TIME, HAND_REST = 3.0, 0.5

#: Tremor of a hand: frequencies [Hz], and RMS rotation [rad] and displacement [m] per axis. Physiological tremor has 8
#: to 12 Hz and 0.1 to 0.5 mm at the hand.
TREMOR_BAND, TREMOR = (8.0, 12.0), (2e-3, 2e-4)

#: Slow drift of a hand that rests: frequencies [Hz], and RMS velocity per axis [rad/s], [m/s].
DRIFT_BAND, DRIFT_SPEED = (0.1, 0.4), (3e-3, 1e-3)

#: Number of sine waves of tremor and drift per axis. The sum of four is irregular.
NUM_WAVES = 4

#: Duration of the designed motion [s], and rate of its recording [Hz].
MOTION, RATE = 20.0, 200.0

#: Factor of the base parameters in the wrong model.
WRONG = 1.2

#: Encoder counts by which a held joint may move. The controller does not notice a smaller motion in time.
COUNTS = 5.0


class TremblingHand(LeafSystem):
    """Hand that leads an arm along a trajectory and lets go at its end. It is compliant, trembles and drifts.

    It is the spring and damper of `Hand` with the default `Grip`, linearized about the end of the trajectory. The
    linearization needs a tenth of the time, and differs little over the short motion before a release.
    """

    def __init__(self, arm, trajectory, time_step, seed):
        super().__init__()
        self._trajectory, self._velocity = trajectory, trajectory.MakeDerivative()
        frame, grip = ArmFrame(arm), Grip()
        q = trajectory.value(trajectory.end_time()).ravel()
        self._J = J = frame.jacobian(q)
        self._K = K = np.repeat([grip.rotational_stiffness, grip.stiffness], 3)
        self._D = np.repeat([grip.rotational_damping, grip.damping], 3) + time_step * K
        implicit = np.eye(6) + (time_step * self._D)[:, None] * (J @ np.linalg.solve(frame.mass_matrix(q), J.T))
        self._to_effort = J.T @ np.linalg.inv(implicit)
        random, size = np.random.default_rng(seed), (6, NUM_WAVES)
        tremor, drift = (2.0 * np.pi * random.uniform(*band, size) for band in (TREMOR_BAND, DRIFT_BAND))
        amplitudes = np.broadcast_to(np.repeat(TREMOR, 3)[:, None], size), np.repeat(DRIFT_SPEED, 3)[:, None] / drift
        self._omega, self._amplitude = np.hstack([tremor, drift]), np.sqrt(2.0 / NUM_WAVES) * np.hstack(amplitudes)
        self._phase = random.uniform(0.0, 2.0 * np.pi, self._omega.shape)
        self.DeclareVectorInputPort("state_estimated", 2 * arm.num_joints)
        self.DeclareVectorOutputPort("effort_disturbance", arm.num_joints, self._calc_effort)

    def _calc_effort(self, context, output):
        time = context.get_time()
        if time >= self._trajectory.end_time():
            output.SetZero()
            return
        q, v = np.split(self.get_input_port().Eval(context), 2)
        error = self._J @ (self._trajectory.value(time).ravel() - q)
        error += np.sum(self._amplitude * np.sin(self._omega * time + self._phase), axis=1)
        error_rate = self._J @ (self._velocity.value(time).ravel() - v)
        output.SetFromVector(self._to_effort @ (self._K * error + self._D * error_rate))


def release_by_hand(arm, model, pose, mode, duration, seed):
    """Simulates a hand that leads the arm to a pose and lets go; returns the positions (samples, n) after that."""
    name, release_time = arm.name.lower(), HAND_TIME + HAND_REST
    knots = np.column_stack([approach_start(arm, pose, seed), pose, pose])
    trajectory = PiecewisePolynomial.CubicHermite([0.0, HAND_TIME, release_time], knots, np.zeros_like(knots))
    builder = DiagramBuilder()
    station = dvrk.ArmStation(arm, effects=arm.effects, seed=seed)
    dvrk.add_closed_loop(builder, station, dvrk.GravityPidController(model, mode=mode))
    hand = builder.AddSystem(TremblingHand(arm, trajectory, station.plant.time_step(), seed))
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


def identified(arm, path):
    """Designs a motion, simulates it with all effects, identifies a model from its recording and saves the model."""
    motion = dvrk.design_excitation(arm, duration=MOTION, starts=1).motion
    t = np.arange(round(MOTION * RATE) + 1) / RATE
    q, v = motion.evaluate(t)[:2]
    desired = TrajectorySource(PiecewisePolynomial.CubicHermite(t, q.T, v.T), output_derivative_order=1)
    builder, station = DiagramBuilder(), dvrk.ArmStation(arm, effects=arm.effects)
    dvrk.add_closed_loop(builder, station, dvrk.GravityPidController(dvrk.IdentifiedModel.from_arm(arm)), desired)
    ports = (station.GetOutputPort(f"{arm.name.lower()}.{port}") for port in ("state_estimated", "effort_measured"))
    logs = [LogVectorOutput(port, builder, 1.0 / RATE) for port in ports]
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    station.SetPositions(station.GetMyMutableContextFromRoot(context), q[0])
    simulator.AdvanceTo(MOTION)
    state, effort = (log.FindLog(context).data().T for log in logs)
    q, v = np.split(state, 2, axis=1)
    recording = dvrk.Recording(t=logs[0].FindLog(context).sample_times(), q=q, qd=v, tau=effort)
    dvrk.identify(recording, arm).model.save(path)


def main() -> None:
    """Prints a table of the releases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calibration", type=Path, help="folder of a calibration, or name of an arm")
    parser.add_argument("--releases", type=int, default=200, help="number of releases; default: %(default)s")
    parser.add_argument("--models", nargs="+", help="static, model, exact, wrong, identified; default: all that exist")
    parser.add_argument("--modes", nargs="+", default=["gravity", "guide"], help="modes; default: %(default)s")
    parser.add_argument("--approaches", nargs="+", default=list(APPROACHES), help="approaches; default: %(default)s")
    parser.add_argument("--duration", type=float, default=3.0, help="simulated time [s]; default: %(default)s")
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
    unit, coarse = np.where(arm.prismatic, 1e4, 1e3), COUNTS * arm.encoder_counts() > arm.per_joint(*BAND)
    rows = {}
    with ProcessPoolExecutor(options.processes) as executor, TemporaryDirectory() as folder:
        for name, factor in (("exact", 1.0), ("wrong", WRONG)):
            with_error(true, true, factor, poses).save(Path(folder) / f"{name}.yaml")
        for name in options.models or [*(["static", "model"] if is_calibrated else ["identified"]), "exact", "wrong"]:
            path = (options.calibration if name in ("static", "model") else Path(folder)) / f"{name}.yaml"
            if name == "identified":
                identified(arm, path)
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
                        *(f"{np.median((unit * largest)[:, use].max(axis=1)):.1f}" for use in (~coarse, slice(None))),
                        *(f"{x:.1f}" for x in unit * largest.max(axis=0)),
                        f"{(unit * ripple).max():.2f}",
                    ]
                    print(f"{name}, {mode}, {APPROACHES[approach]}:", *rows[f"{name}, {mode}, {APPROACHES[approach]}"])
    headings = [
        "held",
        "median of the largest joint without coarse encoders [mrad, 0.1 mm]",
        "of all joints",
        *(f"{name} [{'0.1 mm' if p else 'mrad'}]" for name, p in zip(arm.joint_names, arm.prismatic, strict=True)),
        "largest motion in the last second [mrad, 0.1 mm]",
    ]
    print_table(f"{arm.name}: releases, and largest distance of each joint from its release pose", headings, rows)


if __name__ == "__main__":
    main()
