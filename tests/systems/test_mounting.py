"""Arms in other mountings: gravity has another direction in the base frame."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

pytestmark = [pytest.mark.numeric, pytest.mark.drake_api]


def drift(arm, mounted, model):
    """Returns the motion [rad, m] of each joint in 0.5 s under the model's gravity compensation."""
    name = arm.name.lower()
    builder = DiagramBuilder()
    station = builder.AddSystem(ArmStation(arm, plant_arm=mounted, closure="ball"))
    controller = builder.AddSystem(GravityPidController(model, mode="gravity"))
    builder.Connect(station.GetOutputPort(f"{name}.state_estimated"), controller.GetInputPort("state_estimated"))
    builder.Connect(controller.GetOutputPort("effort"), station.GetInputPort(f"{name}.effort_commanded"))
    simulator = Simulator(builder.Build())
    context = station.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    q = (arm.position_lower + 2 * arm.position_upper) / 3
    q[2] -= 0.4 if name == "mtml" else 0.0  # inside the parallelogram's stops
    assert not arm.limit_violations(q)
    station.SetPositions(context, q)
    simulator.AdvanceTo(0.5)
    return np.abs(station.GetPositions(context) - q)


@pytest.mark.parametrize(
    ("name", "gravity"), [("mtml", (3.0, 2.0, -9.1)), ("mtml", (0.0, 0.0, 9.81)), ("psm", (0.0, -9.81, 0.0))]
)
def test_only_model_of_same_mounting_holds_the_arm(name, gravity):
    arm = load_arm(name)
    mounted = arm.with_gravity(gravity)
    model = IdentifiedModel.from_arm(mounted)
    assert np.all(np.abs(model.holding_torque((arm.position_lower + 2 * arm.position_upper) / 3)) < arm.effort_limits)
    assert drift(arm, mounted, model).max() < 1e-5
    assert drift(arm, mounted, IdentifiedModel.from_arm(arm)).max() > 0.05
