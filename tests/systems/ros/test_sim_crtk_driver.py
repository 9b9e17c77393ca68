"""Simulated arm with the driver of a dVRK, without ROS and without the wall clock."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.errors import ModelError, StationError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.typed_yaml import load_typed_yaml
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.driver import CrtkDriver
from dvrk_drake.systems.ros.crtk_arm_state import CrtkCommand
from dvrk_drake.systems.ros.sim_crtk_driver import SimCrtkDriver

pytestmark = pytest.mark.drake_api

#: Pose inside the limits of the arm, away from its equilibrium.
POSES = {"mtml": np.array([0.2, 0.3, -0.2, 0.1, 0.3, 0.1, 0.1]), "psm": np.array([0.2, 0.3, 0.1, 0.1, 0.2, 0.3, 0.4])}


class Simulated:
    """Simulated arm with its driver."""

    def __init__(self, name, effects=None, **options):
        self.arm, self.lines = load_arm(name), []
        builder = DiagramBuilder()
        chosen = None if effects is None else self.arm.effects.only(effects)
        self.station = builder.AddSystem(ArmStation(self.arm, effects=chosen))
        self.driver = builder.AddSystem(SimCrtkDriver(self.arm, CrtkDriver(**options), report=self.lines.append))
        for port in ("state_estimated", "effort_measured"):
            builder.Connect(self.station.GetOutputPort(f"{name}.{port}"), self.driver.GetInputPort(port))
        builder.Connect(
            self.driver.GetOutputPort("effort_commanded"), self.station.GetInputPort(f"{name}.effort_commanded")
        )
        self.simulator = Simulator(builder.Build())
        self.context = self.simulator.get_mutable_context()
        self.num_main = self.arm.num_joints - bool(self.arm.separate_joint)
        self.put(POSES[name])
        self.simulator.Initialize()

    @property
    def q(self):
        return self.station.GetPositions(self.station.GetMyContextFromRoot(self.context))

    @property
    def effort(self):
        return self.driver.GetOutputPort("effort_commanded").Eval(self.driver.GetMyContextFromRoot(self.context))

    @property
    def machine(self):
        return self.driver.GetMachine(self.driver.GetMyContextFromRoot(self.context))

    def put(self, q):
        self.station.SetPositions(self.station.GetMyMutableContextFromRoot(self.context), q)

    def send(self, name, values=(), seconds=0.01, **options):
        self.driver.Receive(CrtkCommand(name, values, **options))
        self.wait(seconds)

    def wait(self, seconds):
        self.simulator.AdvanceTo(self.context.get_time() + seconds)

    def home(self):
        """Homes the arm near its home pose, then regulates the pose of `POSES`. Returns this pose."""
        self.put(np.clip(0.0, self.arm.position_lower, self.arm.position_upper))
        self.send("state_command", text="enable")
        self.send("state_command", text="home", seconds=0.4)
        assert self.machine.is_ready
        q = POSES[self.arm.name.lower()]
        self.put(q)
        if self.arm.separate_joint:
            self.send(f"{self.arm.separate_joint}/servo_jp", q[self.num_main :], seconds=0.0)
        self.send("servo_jp", q[: self.num_main], seconds=0.2)
        return q


@pytest.mark.parametrize("name", POSES)
def test_efforts_act_on_the_arm(name):
    simulated = Simulated(name)
    start, n = simulated.q, simulated.num_main
    simulated.wait(0.2)
    assert np.max(np.abs(simulated.q - start)) > 0.02, "without power, the arm falls"
    assert np.all(simulated.effort == 0)
    q = simulated.home()
    np.testing.assert_allclose(simulated.q, q, rtol=0, atol=1e-3)
    # With the gravity compensation of the exact model, the arm stays.
    simulated.send("use_gravity_compensation", is_on=True)
    simulated.send("servo_jf", np.zeros(n), seconds=0.5)
    np.testing.assert_allclose(simulated.q, q, rtol=0, atol=5e-3)
    gravity = IdentifiedModel.from_arm(simulated.arm).holding_torque(simulated.q)
    np.testing.assert_allclose(simulated.effort[:n], gravity[:n], rtol=0, atol=1e-3)
    # The same efforts as a command, without gravity compensation.
    simulated.send("use_gravity_compensation", is_on=False, seconds=0.0)
    simulated.send("servo_jf", gravity[:n], seconds=0.1)
    np.testing.assert_allclose(simulated.q, q, rtol=0, atol=0.03)
    # The arm falls with zero efforts, and hold stops it.
    before = simulated.q
    simulated.send("servo_jf", np.zeros(n), seconds=0.3)
    assert np.max(np.abs(simulated.q - before)) > 0.05
    # "free" is the same as zero efforts. There is no time limit.
    simulated.send("free", seconds=0.1)
    assert np.all(simulated.effort[:n] == 0)
    simulated.send("hold")
    held = simulated.machine.desired_state
    simulated.wait(1.0)
    np.testing.assert_array_equal(simulated.machine.desired_state, held)
    np.testing.assert_allclose(simulated.q, held[:7], rtol=0, atol=0.05)
    # Positive effort moves a joint in its positive direction.
    effort = gravity[:n].copy()
    effort[0] += 0.1 * simulated.arm.effort_limits[0]
    simulated.home()
    simulated.send("servo_jf", effort, seconds=0.1)
    assert simulated.q[0] > q[0] + 1e-3


@pytest.mark.parametrize("name", POSES)
def test_servo_cp_moves_the_last_frame(name):
    simulated = Simulated(name)
    q = simulated.home()
    kinematics = ArmFrame(simulated.arm)
    X = kinematics.pose(q)
    r = X.rotation().ToQuaternion()
    p = X.translation() + np.array([0.01, -0.005, 0.008])
    simulated.send("servo_cp", [*p, r.x(), r.y(), r.z(), r.w()], seconds=1.0)
    reached = kinematics.pose(simulated.q)
    np.testing.assert_allclose(reached.translation(), p, rtol=0, atol=1e-3)
    np.testing.assert_allclose(reached.rotation().matrix(), X.rotation().matrix(), rtol=0, atol=1e-2)
    before = simulated.machine.desired_state
    simulated.send("servo_cp", [1.0, 1.0, 1.0, r.x(), r.y(), r.z(), r.w()])
    np.testing.assert_array_equal(simulated.machine.desired_state, before)
    assert "servo_cp refused: the arm cannot reach the pose from the present set-point" in simulated.lines


def test_driver_file(tmp_path):
    path = tmp_path / "driver.yaml"
    path.write_text("domain: 3\nnamespace: dvrk/MTML\nrate: 500\ngravity_compensation: true\n")
    driver = load_typed_yaml(CrtkDriver, path, StationError, "a driver's configuration")
    assert driver == CrtkDriver(domain=3, namespace="dvrk/MTML", rate=500.0, gravity_compensation=True)
    names = [CrtkDriver(namespace=text).arm_namespace(load_arm("psm")) for text in ("", "/PSM2", "dvrk/PSM2/")]
    assert names == ["/PSM1", "/PSM2", "/dvrk/PSM2"]
    assert CrtkDriver().arm_namespace(load_arm("mtmr")) == "/MTMR"
    driver = CrtkDriver(model="model.yaml")
    driver.relative_to(tmp_path)
    with pytest.raises(ModelError, match=str(tmp_path / "model.yaml")):
        driver.load_model(load_arm("mtml"))
