"""Process that simulates one dVRK arm with CRTK topics over ROS 2, started by `dvrk-drake sim-arm --transport ros`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects
from dvrk_drake.processes.pace import Pace
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.ros.crtk_arm_state import CrtkCommand
from dvrk_drake.systems.ros.crtk_driver import CrtkDriver
from dvrk_drake.systems.ros.open_domain import open_ros_domain
from dvrk_drake.systems.ros.sim_crtk_driver import PERIOD, apply_crtk_driver_config

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.domain import RosDomain

#: Time in which DDS discovers other processes [s]. Longest time until DDS considers a killed process as ended [s]; the
#: default of Cyclone DDS is 10 s.
_DISCOVERY, _ENDED = 1.0, 12.0


class SimulatedRosArm:
    """Simulated arm with the CRTK topics of a dVRK, stepped by the wall clock.

    Attributes:
        source: ROS domain and namespace of the topics, for messages.
    """

    def __init__(
        self,
        arm: Arm,
        driver: CrtkDriver,
        q: ArrayLike,
        effects: ArmEffects | None = None,
        *,
        enabled: bool = False,
    ) -> None:
        """Creates the arm at rest, DISABLED and not homed.

        Args:
            arm: Simulated arm.
            driver: Configuration of the driver.
            q: Initial pose (n,) [rad, m].
            effects: Simulated effects of the real arm. None: no effects.
            enabled: Whether to enable and home the arm in the first step.

        Raises:
            DvrkDrakeError: The package cyclonedds is missing, or the domain cannot be used.
            StationError: Another arm publishes in the namespace.
            ModelError: The driver's model cannot be read, or is not valid for the arm.
        """
        self._report: Callable[[str], None] = lambda line: None
        domain = open_ros_domain(driver.domain)
        self.source = f"{domain.name}, topics {driver.arm_namespace(arm)}/..."
        builder = DiagramBuilder()
        station = builder.AddSystem(ArmStation(arm, effects=effects))
        _refuse_other_arm(domain, f"{driver.arm_namespace(arm)}/measured_js")
        sim_driver = apply_crtk_driver_config(driver, station, builder, domain=domain, report=self._report_with_time)
        for text in ("enable", "home") if enabled else ():
            sim_driver.Receive(CrtkCommand("state_command", text=text))
        self._simulator = Simulator(builder.Build())
        context = self._simulator.get_mutable_context()
        station.SetPositions(station.GetMyMutableContextFromRoot(context), q)
        self._ticks = 0

    def step(self) -> None:
        """Processes the received commands, publishes measurements and advances by one period."""
        self._ticks += 1
        self._simulator.AdvanceTo(self._ticks * PERIOD)

    def run(
        self,
        stopped: Callable[[], bool],
        report: Callable[[str], None] = lambda line: None,
        enter: Callable[[], bool] = lambda: False,
    ) -> Pace:
        """Steps the simulation by the wall clock until `stopped` returns true.

        Args:
            stopped: Function that returns whether to stop. It is called once per tick.
            report: Function that is called with a line of text on each change of state or mode and on refused commands.
            enter: Not used, because a dVRK has no guard. `SimulatedArm.run` has this argument.

        Returns:
            Pace with the number of late ticks.
        """
        self._report = report
        self._simulator.Initialize()
        pace = Pace(PERIOD)
        while not stopped():
            pace.wait()
            self.step()
        return pace

    def _report_with_time(self, line: str) -> None:
        self._report(f"{self._simulator.get_context().get_time():9.3f} s  {line}")


def _refuse_other_arm(domain: RosDomain, topic: str) -> None:
    """Raises StationError if another process publishes `topic`. Clients would receive the measurements of both arms."""
    domain.wait_until(lambda: False, _DISCOVERY)
    if not domain.wait_until(lambda: topic not in domain.joint_state_topics(), _ENDED):
        raise StationError(
            f"another arm publishes {topic} in {domain.name}. End it, or choose another --topic or --domain"
        )
