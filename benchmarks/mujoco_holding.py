"""Compares MuJoCo with Drake on exported MJCF files: poses that are held, and a motion under a controller.

    python benchmarks/mujoco_holding.py [--poses 20] [--seconds 3]     (requires: pip install mujoco)

Hold: each arm starts at rest at random poses and is simulated for 1 s with the constant holding torques of the model,
without friction and with the friction of the file, and without its springs. Largest change of a joint position.

Gravity: largest difference between MuJoCo's gravity torque and the holding torque, at the independent joints.

Replay: the sample motion of an MTMR and of a PSM is tracked by gravity compensation with a PD controller at 1 kHz and
the gains of the arm file, in MuJoCo (with the friction of the file) and in Drake (ArmStation with the friction of the
drives, which includes presliding). Largest tracking errors in both, and RMS difference of the efforts.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np
from pydrake.systems.analysis import Simulator

import dvrk_drake as dvrk
from dvrk_drake.recordings.formats import SAMPLES, SAMPLES_FOLDER
from dvrk_drake.systems.arm_station import ArmStation

ARMS = ("mtml", "psm", "psm_si", "ecm", "ecm_si")


class MujocoArm:
    """Exported arm in MuJoCo, with positions, velocities and efforts of the independent joints."""

    def __init__(self, model: dvrk.IdentifiedModel, folder: str) -> None:
        path = Path(folder) / f"{model.arm.source}.xml"
        dvrk.export_model(model, path, "mjcf", overwrite=True)
        self.arm, self.model = model.arm, mujoco.MjModel.from_xml_path(str(path))
        self.data = mujoco.MjData(self.model)
        tree = [self.model.joint(name).id for name in self.arm.tree_joint_names]
        self.places, self.dofs = self.model.jnt_qposadr[tree], self.model.jnt_dofadr[tree]
        self.own = [self.arm.tree_joint_names.index(name) for name in self.arm.joint_names]

    def start(self, q: np.ndarray, v: np.ndarray | None = None) -> None:
        """Sets positions and velocities (n,)."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self.places] = self.arm.linkage.position(q)
        self.data.qvel[self.dofs] = 0.0 if v is None else self.arm.linkage.velocity(v)

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions and velocities (n,)."""
        return self.data.qpos[self.places[self.own]].copy(), self.data.qvel[self.dofs[self.own]].copy()

    def step(self, effort: np.ndarray, count: int = 1) -> None:
        """Applies efforts (n,) for some steps of 1 ms."""
        self.data.ctrl[[self.model.actuator(name).id for name in self.arm.joint_names]] = effort
        mujoco.mj_step(self.model, self.data, count)


class DrakeArm:
    """Simulated arm in Drake with the friction of its drives."""

    def __init__(self, arm: dvrk.Arm) -> None:
        self.station = ArmStation(arm, effects=arm.effects.only(["friction"]))
        self.simulator = Simulator(self.station)
        self.name = arm.name.lower()

    def start(self, q: np.ndarray, v: np.ndarray) -> None:
        """Sets positions and velocities (n,)."""
        context = self.simulator.get_mutable_context()
        context.SetTime(0.0)
        self.station.SetDefaultContext(context)
        self.station.SetPositions(context, q)

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions and velocities (n,)."""
        state = self.station.GetOutputPort(f"{self.name}.state_true").Eval(self.simulator.get_context())
        return np.split(state, 2)[0], np.split(state, 2)[1]

    def step(self, effort: np.ndarray) -> None:
        """Applies efforts (n,) for 1 ms."""
        context = self.simulator.get_mutable_context()
        self.station.GetInputPort(f"{self.name}.effort_commanded").FixValue(context, effort)
        self.simulator.AdvanceTo(context.get_time() + 1e-3)


def hold(mujoco_arm: MujocoArm, model: dvrk.IdentifiedModel, poses: int) -> None:
    """Prints a row per friction setting."""
    arm = model.arm
    q = arm.sample_poses(poses, np.random.default_rng(3), margin=0.1)
    tau = model.holding_torque(q)
    flags = mujoco.mjtDisableBit
    for friction in (False, True):
        # The holding torques do not contain those of springs.
        mujoco_arm.model.opt.disableflags = flags.mjDSBL_SPRING | (0 if friction else flags.mjDSBL_FRICTIONLOSS)
        moved, difference = np.zeros(arm.num_joints), 0.0
        for pose, torque in zip(q, tau, strict=True):
            mujoco_arm.start(pose)
            mujoco.mj_forward(mujoco_arm.model, mujoco_arm.data)
            gravity = arm.linkage.pull_back_effort(mujoco_arm.data.qfrc_bias[mujoco_arm.dofs])
            difference = max(difference, float(np.abs(gravity - torque).max()))
            mujoco_arm.step(torque, 1000)
            moved = np.maximum(moved, np.abs(mujoco_arm.state()[0] - pose))
        largest = [f"{np.max(moved[kind], initial=0.0):.1e}" for kind in (~arm.prismatic, arm.prismatic)]
        what = f"{arm.source:7} {'yes' if friction else 'no':9}"
        print(f"{what} {largest[0]:19} {largest[1]:8} {difference:.0e}", flush=True)


def replay(simulated: MujocoArm | DrakeArm, model: dvrk.IdentifiedModel, motion: dvrk.Recording, seconds: float):
    """Returns tracking errors and efforts (m, n) in a simulation."""
    arm, count = model.arm, int(1000 * seconds)
    t = 1e-3 * np.arange(count + 1)
    q_d = np.column_stack([np.interp(t, motion.t - motion.t[0], column) for column in motion.q.T])
    v_d = np.gradient(q_d, 1e-3, axis=0)
    gains = arm.gains
    simulated.start(q_d[0], v_d[0])
    errors, efforts = [], []
    for desired, speed in zip(q_d, v_d, strict=True):
        q, v = simulated.state()
        effort = model.holding_torque(q[None])[0] + gains.kp * (desired - q) + gains.kd * (speed - v)
        effort = np.clip(effort, -arm.effort_limits, arm.effort_limits)
        errors.append(desired - q)
        efforts.append(effort)
        simulated.step(effort)
    return np.array(errors), np.array(efforts)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=20, help="number of poses; default: %(default)s")
    parser.add_argument("--seconds", type=float, default=3.0, help="duration of the replay [s]; default: %(default)s")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        print("arm     friction  moved in 1 s [rad]  [m]      gravity [N m; N]")
        for name in ARMS:
            model = dvrk.IdentifiedModel.from_arm(dvrk.load_arm(name), dynamics=True)
            hold(MujocoArm(model, folder), dvrk.IdentifiedModel.from_arm(model.arm), options.poses)
        print("\njoint              largest error, MuJoCo  Drake     RMS effort [N m; N]  RMS difference")
        for sample in ("mtm_motion", "psm_motion"):
            model = dvrk.IdentifiedModel.from_arm(dvrk.load_arm(SAMPLES[sample]), dynamics=True)
            nominal, arm = dvrk.IdentifiedModel.from_arm(model.arm), model.arm
            motion = dvrk.read_recording(SAMPLES_FOLDER / f"{sample}.csv", arm).in_joint_coordinates(arm)
            results = [replay(s, nominal, motion, options.seconds) for s in (MujocoArm(model, folder), DrakeArm(arm))]
            (errors, efforts), (own_errors, own_efforts) = results
            for i, joint in enumerate(arm.joint_names):
                largest = [np.abs(e[100:, i]).max() for e in (errors, own_errors)]
                rms = [np.sqrt(np.mean(e[100:, i] ** 2)) for e in (own_efforts, efforts - own_efforts)]
                print(f"{joint:18} {largest[0]:<22.2g} {largest[1]:<9.2g} {rms[0]:<20.3g} {rms[1]:.2g}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
