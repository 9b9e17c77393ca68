"""Station of an arm with friction, cable and sensor effects, advanced step by step."""

import numpy as np
from pydrake.systems.analysis import Simulator

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.arm_station import ArmStation

ARMS = ["mtml", "mtmr", "psm"]
STEP = 1e-3


def weightless(name):
    return load_arm(name).with_gravity([0.0, 0.0, 0.0])


def middle(arm):
    return 0.5 * (arm.position_lower + arm.position_upper)


class Run:
    """Station that starts at rest at q and is advanced step by step."""

    def __init__(self, arm, effects, q=None, seed=0):
        self.arm, self.name = arm, arm.name.lower()
        self.station = ArmStation(arm, effects=effects, seed=seed)
        self.simulator = Simulator(self.station)
        self.context = self.simulator.get_mutable_context()
        self.station.SetPositions(self.context, middle(arm) if q is None else q)
        self.simulator.Initialize()
        self.tick = 0

    def fix(self, port, value):
        self.station.GetInputPort(f"{self.name}.{port}").FixValue(self.context, value)

    def get(self, port):
        return self.station.GetOutputPort(f"{self.name}.{port}").Eval(self.context).copy()

    def advance(self, ticks=1):
        self.tick += ticks
        self.simulator.AdvanceTo(self.tick * STEP)

    @property
    def q(self):
        return self.station.GetPositions(self.context)

    @property
    def v(self):
        return self.get("state_true")[self.arm.num_joints :]


def breakaway(arm):
    """Returns the breakaway effort (n,) of the actuators [N m, N], from friction along the actuators only."""
    total = dict.fromkeys(arm.joint_names, 0.0)
    for effect in arm.effects.friction:
        owner, _, actuator = effect.coordinate.partition(".")
        if owner == "actuator" and effect.kind == "presliding":
            total[actuator] += effect.coefficient
    return np.array(list(total.values()))
