# /// script
# requires-python = ">=3.11"
# dependencies = ["dvrk_drake"]
# ///
"""Connects your own controller, a Drake LeafSystem, to a simulated arm (tutorial "Build your own Diagram")."""

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

import dvrk_drake as dvrk


class ImpedanceController(LeafSystem):
    """Computes tau = g(q) + stiffness (q_d - q) - damping v.

    .. pydrake_system::

        name: ImpedanceController
        input_ports:
        - state_estimated
        output_ports:
        - effort
    """

    def __init__(self, model, q_d, stiffness, damping):
        super().__init__()
        n = model.arm.num_joints
        self._model, self._q_d = model, np.array(q_d)
        self._stiffness, self._damping = stiffness, damping
        self._state = self.DeclareVectorInputPort("state_estimated", 2 * n)
        self.DeclareVectorOutputPort("effort", n, self._calc_effort)

    def _calc_effort(self, context, output):
        q, v = np.split(self._state.Eval(context), 2)
        spring = self._stiffness * (self._q_d - q)
        output.SetFromVector(self._model.holding_torque(q) + spring - self._damping * v)


arm = dvrk.load_arm("mtml")
start, desired = np.array([0, 0.3, -0.2, 0, 0.5, 0, 0]), np.array([0.2, 0.4, -0.2, 0.3, 0.7, 0.2, 0.3])
builder = DiagramBuilder()
station = dvrk.ArmStation(arm)
model, kp, kd = dvrk.IdentifiedModel.from_arm(arm), np.array(arm.gains.kp), np.array(arm.gains.kd)
controller = ImpedanceController(model, desired, 0.5 * kp, kd)
dvrk.add_closed_loop(builder, station, controller)
simulator = Simulator(builder.Build())
context = station.GetMyMutableContextFromRoot(simulator.get_mutable_context())
station.SetPositions(context, start)
simulator.AdvanceTo(3.0)
print("error before [rad]", np.round(desired - start, 3))
print("error after  [rad]", np.round(desired - station.GetPositions(context), 3))
