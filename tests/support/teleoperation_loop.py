"""Teleoperation with an ideal follower, and poses of the handle and the instrument tip."""

import numpy as np

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions
from dvrk_drake.systems.teleoperation import Teleoperation

MTM, PSM = load_arm("mtml"), load_arm("psm")
#: Maximum speeds of yaw, pitch, insertion, roll, wrist pitch, wrist yaw, jaw [rad/s, m/s] (Wang et al. 2019).
SPEED = np.array([1.7, 1.7, 0.35, 2.0, 2.0, 3.0, 3.0])
PERIOD = 1e-3
Q_M = np.array([0.1, 0.3, -0.1, 0.2, 1.0, 0.1, 0.3])
Q_F = np.array([0.2, -0.1, 0.13, 0.4, 0.2, -0.3, 0.5])


def pose(arm, frame, q):
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    set_arm_positions(plant, context, arm, q)
    return plant.GetFrameByName(frame).CalcPoseInWorld(context)


def handle(q):
    return pose(MTM, "dh_7", q)


def tip(q):
    return pose(PSM, "dh_6", q)


def angle(R):
    return abs(R.ToAngleAxis().angle())


class Loop:
    """`Teleoperation` with a follower that reaches each command immediately, unless specified otherwise."""

    def __init__(self, q_follower=Q_F, q_master=Q_M, arms=(MTM, PSM), **arguments):
        self.system, self.num_joints = Teleoperation(*arms, **arguments), arms[1].num_joints
        self.context = self.system.CreateDefaultContext()
        self.inputs = {"master_position": q_master, "follower_position": q_follower, "engaged": 0.0, "jaw_angle": 0.5}
        self.step()

    def step(self, follower=None, **inputs):
        """Runs one update; returns the desired positions (n,) and velocities (n,)."""
        self.inputs.update(inputs)
        if follower is not None:
            self.inputs["follower_position"] = follower
        for name, value in self.inputs.items():
            self.system.GetInputPort(name).FixValue(self.context, np.atleast_1d(value))
        state = self.context.get_mutable_discrete_state()
        state.SetFrom(self.system.EvalUniquePeriodicDiscreteUpdate(self.context))
        desired = self.system.GetOutputPort("desired_state").Eval(self.context)
        if follower is None and np.all(np.isfinite(desired)):
            self.inputs["follower_position"] = desired[: self.num_joints].copy()
        return desired[: self.num_joints].copy(), desired[self.num_joints :].copy()

    def move(self, q_master, steps=400):
        """Moves the master to q_master (n,) in `steps` steps, then waits. Returns the desired positions (m, n)."""
        start = np.array(self.inputs["master_position"])
        positions = [self.step(master_position=start + s * (q_master - start))[0] for s in np.linspace(0, 1, steps)]
        return np.array(positions + [self.step()[0] for _ in range(steps)])

    def flag(self, name):
        return self.system.GetOutputPort(name).Eval(self.context)[0]
