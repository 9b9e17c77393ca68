"""Processes of one arm: simulated over LCM or ROS 2 (`dvrk-drake sim-arm`), or a bridge to a dVRK (`bridge`)."""

from __future__ import annotations

import contextlib
import select
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import lcm
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ModelError, StationError
from dvrk_drake.lcmtypes import lcmt_dvrk_force
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects
from dvrk_drake.models.lcm_messages import command_channel, describe_state, force_channel, status_channel
from dvrk_drake.models.typed_yaml import load_typed_yaml
from dvrk_drake.processes.force_monitor import ForceMonitor
from dvrk_drake.processes.pace import Pace
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.driver import CrtkDriver, DvrkDriver
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.lcm.messages import handle_message, listen
from dvrk_drake.systems.lcm.sim_dvrk_driver import apply_driver_config
from dvrk_drake.systems.ros.crtk_arm_state import CrtkCommand
from dvrk_drake.systems.ros.open_domain import open_ros_domain, require_cyclonedds
from dvrk_drake.systems.ros.sim_crtk_driver import PERIOD, apply_crtk_driver_config

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.domain import RosDomain

#: Length of the queue of commands. If the queue is full, further commands are dropped. Largest number of commands that
#: are handled at the start of a tick. It limits the delay that a flood of messages can cause. Most commands are handled
#: while this process waits for the next tick.
_QUEUE, _MESSAGES_PER_STEP = 200, 10

#: Largest effort that holds the default initial pose, as a share of the effort limits.
_START_EFFORT = 0.6
#: Time in which DDS discovers other processes [s]. Longest time until DDS considers a killed process as ended [s]; the
#: default of Cyclone DDS is 10 s.
_DISCOVERY, _ENDED = 1.0, 12.0


def monotonic_utime() -> int:
    """Returns the time of the computer's monotonic clock [us]."""
    return time.monotonic_ns() // 1000


def load_driver(path: str | Path) -> DvrkDriver:
    """Reads the configuration of a driver from a YAML file. Missing entries have their default values.

    Raises:
        StationError: The file cannot be read or has an invalid entry.
    """
    driver = load_typed_yaml(DvrkDriver, path, StationError, "a driver's configuration")
    try:
        driver.check()
    except StationError as error:
        raise StationError(f"{path}: {error}") from error
    driver.relative_to(Path(path).parent)
    return driver


def nominal_model(arm: Arm, effects: ArmEffects | None) -> IdentifiedModel:
    """Returns the model of the SDF, with the springs and cables of the simulated effects."""
    return IdentifiedModel.from_arm(arm, effects.position_dependent if effects else ())


def start_pose(arm: Arm, pose: Sequence[float] | None = None, effects: ArmEffects | None = None) -> NDArray[np.float64]:
    """Returns the initial pose (n,) of a simulated arm.

    Args:
        arm: Simulated arm.
        pose: Pose (n,) [rad, m]. None: each joint starts at the position nearest to zero that is at least 10 % of its
            range away from its limits. A joint whose motor needs more than `_START_EFFORT` of its limit to hold this
            position starts at the nearest position that needs less.
        effects: Simulated effects of the arm, whose springs and cables the motors must hold.

    Raises:
        StationError: `pose` does not have n entries inside the arm's limits.
    """
    if pose is None:
        inset = 0.1 * (arm.position_upper - arm.position_lower)
        lower, upper = arm.position_lower + inset, arm.position_upper - inset
        q = np.clip(0.0, lower, upper)
        model, allowed = nominal_model(arm, effects), _START_EFFORT * arm.effort_limits
        for j in np.flatnonzero(np.abs(model.holding_torque(q)) > allowed):
            poses = np.tile(q, (201, 1))
            poses[:, j] = np.linspace(lower[j], upper[j], len(poses))
            effort = np.abs(model.holding_torque(poses)[:, j])
            distance = np.where(effort <= allowed[j], np.abs(poses[:, j] - q[j]), np.inf)
            q = poses[int(np.argmin(distance))]
        return q
    q = np.asarray(pose, float)
    if q.shape != (arm.num_joints,) or not np.all(np.isfinite(q)):
        raise StationError(f"a pose of {arm.name} is {arm.num_joints} finite numbers [rad, m]; got {q.tolist()}")
    if violations := arm.limit_violations(q):
        raise StationError(f"{arm.name} cannot start outside its limits: {'; '.join(violations)}")
    return q


class SimulatedArm:
    """Simulated arm with driver and guard, stepped by the wall clock."""

    def __init__(
        self,
        arm: Arm,
        driver: DvrkDriver,
        q: ArrayLike,
        wall_clock: Callable[[], int] = monotonic_utime,
        *,
        effects: ArmEffects | None = None,
    ) -> None:
        """Creates the arm at rest. The arm's clock starts at the current time of day.

        Args:
            arm: Simulated arm.
            driver: Configuration of the driver, with the URL of the LCM network.
            q: Initial pose (n,) [rad, m].
            wall_clock: Function that returns a monotonic time [us]. The guard uses this function, so that commands also
                expire while this process is late or suspended.
            effects: Simulated effects of the real arm. None: no effects.
        """
        self.arm, self.driver = arm, driver
        self._ticks = 0
        self._status = b""
        self._memory = DrakeLcm("memq://")
        self._memory.Subscribe(status_channel(arm), self._keep_status)
        builder = DiagramBuilder()
        station = builder.AddSystem(ArmStation(arm, effects=effects))
        self._driver = apply_driver_config(
            driver,
            station,
            self._memory,
            builder,
            model=nominal_model(arm, effects),
            start_utime=time.time_ns() // 1000,
            subscribe=False,
            wall_clock=wall_clock,
        )
        self._simulator = Simulator(builder.Build())
        context = self._simulator.get_mutable_context()
        station.SetPositions(station.GetMyMutableContextFromRoot(context), q)
        self._simulator.Initialize()

    @property
    def source(self) -> str:
        """LCM network, for messages."""
        return f"LCM {self.driver.lcm_url}"

    @property
    def guard(self) -> CommandGuard:
        """Current guard, read-only."""
        return self._driver.GetGuard(self._driver.GetMyContextFromRoot(self._simulator.get_context()))

    def receive(self, channel: str, data: bytes) -> None:
        """Stores a message of the command channel for the next step."""
        self._driver.Receive(data)

    def step(self) -> None:
        """Processes the stored commands and advances by one period of the driver."""
        self._ticks += 1
        self._simulator.AdvanceTo(self._ticks * self.driver.status_period)
        self._memory.HandleSubscriptions(0)

    def send(self, network: lcm.LCM) -> None:
        """Publishes the last status."""
        network.publish(status_channel(self.arm), self._status)

    def run(
        self,
        stopped: Callable[[], bool],
        report: Callable[[str], None] = lambda line: None,
        enter: Callable[[], bool] = lambda: False,
    ) -> Pace:
        """Steps the simulation by the wall clock until `stopped` returns true.

        A status is published when a tick begins. The simulation then computes the next state while the controller
        computes a command. The command is applied from the next tick on, as on a real arm.

        Args:
            stopped: Function that returns whether to stop. It is called once per tick.
            report: Function that is called with a line of text at every change of the guard's state.
            enter: Function that returns whether a person pressed Enter since the last call; see
                `CommandGuard.allow_reset`.

        Returns:
            Pace with the number of late ticks.
        """
        # LCM is opened here, because its receive thread inherits the scheduling of the thread that opens LCM. Drake's
        # subscription is not used, because it keeps only one message between two steps. The guard would then not detect
        # a second sender.
        network = lcm.LCM(self.driver.lcm_url)
        network.subscribe(command_channel(self.arm), self.receive).set_queue_capacity(_QUEUE)
        # The first measured period of the guard is too long, because it includes the time since the simulation was
        # created. The guard therefore refuses efforts in the first step. The status of this step is not published,
        # because a controller that receives it would refuse to control the arm.
        self.step()
        self.step()
        pace = Pace(self.driver.status_period, sleep=lambda seconds: listen(network, seconds))
        described = ""
        while not stopped():
            pace.wait()
            if enter():
                self._driver.AllowReset()
            for _ in range(_MESSAGES_PER_STEP):
                if not handle_message(network, 0.0):
                    break
            self.send(network)
            self.step()
            if (state := self._describe()) != described:
                report(f"{self._simulator.get_context().get_time():9.3f} s  {state}")
                described = state
        return pace

    def _keep_status(self, data: bytes) -> None:
        self._status = data

    def _describe(self) -> str:
        guard = self.guard
        sender = f", sender {guard.sender_id}" if guard.sender_id else ""
        return describe_state(guard.state, guard.fault_text or guard.hold_reason) + sender


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


def stop_on_signals() -> Callable[[], bool]:
    """Handles SIGINT, SIGTERM and SIGHUP. Returns a function that returns whether one of them was received.

    A closed terminal sends SIGHUP. With nohup, SIGHUP stays ignored.
    """
    received: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda number, frame: received.append(number))
    return lambda: bool(received)


#: Largest number of commands that a bridge handles between two steps; see `_MESSAGES_PER_STEP`.
_MESSAGES_PER_UPDATE = 50
#: Longest wait for a message between two updates of the bridge [s].
_POLL = 0.002
#: Pause of a bridge that polls [s], after an answer and while no controller commands the arm. A thread with real-time
#: scheduling must pause, because Linux stops it for 50 ms per second otherwise (sched_rt_runtime_us).
_PAUSE = 0.0002


def run_bridge(
    arm: Arm,
    driver: DvrkDriver,
    *,
    topic: str | None,
    domain: int | None,
    polls: bool = False,
    publish_force: bool = False,
    stopped: Callable[[], bool],
    report: Callable[[str], None],
    ready: Callable[[], None] = lambda: None,
    enter: Callable[[], bool] = lambda: False,
) -> bool:
    """Connects an arm until `stopped` returns true. The arm then holds its pose.

    Args:
        arm: Arm on ROS 2.
        driver: Configuration of the guard and of the LCM network; `driver.status_period` is not used.
        topic: Topic measured_js of the arm or its namespace; see `find_topic`.
        domain: ROS domain. None: the environment variable ROS_DOMAIN_ID, or else 0.
        polls: Whether to poll for messages while a controller commands the arm. The delay decreases, but the bridge
            uses a processor core.
        publish_force: Whether to publish the external force, estimated with the model of the driver, on both networks.
        stopped: Function that returns whether to stop.
        report: Function that is called with one line for each change of the state.
        ready: Function that is called before the networks are opened, e.g. to request real-time scheduling.
        enter: Function that returns whether a person pressed Enter since the last call; see
            `CommandGuard.allow_reset`.

    Returns:
        Whether the arm has confirmed the last command, `hold`.

    Raises:
        ModelError: The force cannot be estimated with the model of the driver.
        DvrkDrakeError: The arm is not found, its topics do not fit, or another process could move it.
    """
    require_cyclonedds()
    from dvrk_drake.systems.ros.crtk_bridge import connect_bridge

    ready()  # threads of LCM and DDS inherit the scheduling of this thread
    network, channel, problem = lcm.LCM(driver.lcm_url), status_channel(arm), ""

    def send_status(data: bytes) -> None:
        # Without statuses, no command arrives, and the guard holds the arm.
        nonlocal problem
        try:
            network.publish(channel, data)
            problem = ""
        except OSError as error:
            if not problem:
                problem = f"LCM {driver.lcm_url}: the status could not be sent: {error.strerror}"
                report(problem)

    def send_force(force: lcmt_dvrk_force) -> None:
        data = force.encode()
        with contextlib.suppress(OSError):  # reported for the status
            network.publish(force_channel(arm), data if key is None else key.sign(data))
        bridge.send_force(force)

    monitor, key = None, driver.load_key()
    if publish_force:
        if (model := driver.load_model(arm)) is None:
            raise ModelError("the estimated force requires a model of the arm that was identified from a motion")
        monitor = ForceMonitor(model, send=send_force)
    bridge = connect_bridge(
        arm, driver, send_status, topic=topic, domain=domain, report=report, stopped=stopped, polled=polls
    )
    timeout = _PAUSE if polls else _POLL
    try:
        network.subscribe(command_channel(arm), lambda channel, data: bridge.put(data)).set_queue_capacity(_QUEUE)
        while not stopped():
            readable, _, _ = select.select([bridge.fileno(), network.fileno()], [], [], timeout)
            if network.fileno() in readable:
                for _ in range(_MESSAGES_PER_UPDATE):
                    if not handle_message(network, 0.0):
                        break
            if enter():
                bridge.guard.allow_reset()
            is_answer = bridge.update()
            if monitor is not None:
                monitor.update(bridge.status)
            if polls:
                timeout = 0.0 if bridge.is_commanded and not is_answer else _PAUSE
    finally:
        is_confirmed = bridge.close()
    return is_confirmed
