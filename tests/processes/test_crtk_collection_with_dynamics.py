"""Collection through CRTK with a simulated arm that has dynamics and friction, without DDS and the wall clock."""

from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from sticky_arm import Disk

pytest.importorskip("cyclonedds", reason="needs cyclonedds")

from dvrk_drake.analysis.excitation.pose_file import CollectionFile
from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.arm_controller import GoalController, MotionStyle
from dvrk_drake.processes.collector import CollectionSettings, Collector, approaches, estimated_duration
from dvrk_drake.recordings.reading import read_recording
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.ros.crtk_arm_state import CrtkCommand
from dvrk_drake.systems.ros.crtk_driver import CrtkDriver
from dvrk_drake.systems.ros.crtk_move_link import CrtkMoveLink
from dvrk_drake.systems.ros.sim_crtk_driver import SimCrtkDriver

pytestmark = pytest.mark.slow

MTML = load_arm("mtml")
#: Interval of the measurements [s], as with a dVRK.
PERIOD = 0.01
#: Time of the first measurement [s].
START = 100.0


class SimulatedClient:
    """Substitute for CrtkClient: commands and measurements of a simulated arm with friction. Enabled and homed."""

    namespace, not_ready_reason = "/MTML", ""

    def __init__(self, arm):
        self.arm, self.num_received, self.domain = arm, 0, SimpleNamespace(num_changes=0)
        builder = DiagramBuilder()
        name = arm.name.lower()
        self._station = builder.AddSystem(ArmStation(arm, effects=arm.effects.only(["friction"])))
        self._driver = builder.AddSystem(SimCrtkDriver(arm, CrtkDriver()))
        driver = self._driver
        for port in ("state_estimated", "effort_measured"):
            builder.Connect(self._station.GetOutputPort(f"{name}.{port}"), driver.GetInputPort(port))
        builder.Connect(
            driver.GetOutputPort("effort_commanded"), self._station.GetInputPort(f"{name}.effort_commanded")
        )
        self._simulator = Simulator(builder.Build())
        for text in ("enable", "home"):
            driver.Receive(CrtkCommand("state_command", text=text))
        self._simulator.AdvanceTo(1.0)

    @property
    def time(self):
        """Present time [s]."""
        return START + self._simulator.get_context().get_time()

    @property
    def operating_state(self):
        return SimpleNamespace(is_busy=self._machine().is_busy)

    def receive(self):
        """Advances the arm by one period, and measures."""
        self._simulator.AdvanceTo(self.time - START + PERIOD)
        context = self._station.GetMyContextFromRoot(self._simulator.get_context())
        name = self.arm.name.lower()
        state, effort = (
            self._station.GetOutputPort(f"{name}.{port}").Eval(context)
            for port in ("state_estimated", "effort_measured")
        )
        stamp = round(1e9 * self.time)
        self.measurement = SimpleNamespace(
            q=state[: self.arm.num_joints],
            v=state[self.arm.num_joints :],
            effort=effort.copy(),
            stamp=stamp,
            arrival=stamp,
            problem="",
        )
        self.num_received += 1
        return True

    def hold(self):
        self._driver.Receive(CrtkCommand("hold"))

    def move_jp(self, q):
        assert not self.arm.limit_violations(q, 1e-9)
        self._driver.Receive(CrtkCommand("move_jp", q.tolist()))

    def other_publishers(self):
        return []

    def unheard_commands(self, names):
        return []

    def _machine(self):
        return self._driver.GetMachine(self._driver.GetMyContextFromRoot(self._simulator.get_context()))


def remaining_friction(arm, q, settings):
    """Returns a bound (n,) for the friction [N m] that the mean of both approach directions to a pose contains.

    A presliding element is a spring with the stiffness F / s that slides at the force F. If an approach is shorter than
    the travel 2 s from one sliding force to the other, the force does not reach its limit. The mean of both directions
    then contains up to F (1 - d / 2 s), where d is the length of the approach. An element that slides in one direction
    only adds the mean F / 2.
    """
    ends = approaches(arm, q, settings, MotionStyle.of_goals(arm))
    bound = np.zeros(arm.num_joints)
    for effect in arm.effects.friction:
        if effect.kind != "viscous":
            row = arm.effect_coordinates[effect.coordinate] @ arm.transmission.matrix
            length = np.min(np.abs(row @ (ends - q).T))
            share = max(0.0, 1 - length / (2 * effect.scale)) if effect.kind == "presliding" else 0.5
            bound += np.abs(row) * effect.coefficient * share
    return bound


def test_friction_cancels_in_both_approach_directions(tmp_path):
    poses = MTML.sample_poses(4, np.random.default_rng(4), margin=0.1)
    client, model = SimulatedClient(MTML), IdentifiedModel.from_arm(MTML)
    settings = CollectionSettings()
    output = CollectionFile(tmp_path / "p.csv", MTML, both_sides=True)
    link = CrtkMoveLink(client, ControlModel(model), settings.max_effort)
    controller = GoalController(MTML, lambda: link.is_busy)
    collector = Collector(poses, controller, output, settings, writer=Disk())
    start, estimate = client.time, estimated_duration(MTML, np.zeros(7), poses, settings)
    while not collector.finished:
        assert client.time - start < 2 * estimate
        status = link.update(client.time)
        link.send(controller.answer(status, client.time, collector.update(status, client.time)))
    output.close()
    assert collector.problem is None and collector.done.all()
    # A real arm may need more or less time to come to rest.
    assert 0.9 * estimate < client.time - start < 1.2 * estimate
    recording, dry = read_recording(tmp_path / "p.csv"), MTML.dry_friction()
    error = recording.tau - [model.holding_torque(q) for q in recording.q]
    friction = np.array([remaining_friction(MTML, q, settings) for q in recording.q])
    # After a small overshoot, the friction elements with short travels are partly unloaded.
    assert np.all(np.abs(error) < friction + 0.15 * dry)
    # Shoulder and elbow, which carry most of the weight, keep at most half of their dry friction.
    assert np.all(friction[:, :3] < 0.5 * dry[:3])
