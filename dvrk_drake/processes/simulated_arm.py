"""A process that plays one arm behind LCM: `dvrk-drake arm`."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import lcm
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import command_channel, describe_state, status_channel
from dvrk_drake.models.typed_yaml import load_typed_yaml
from dvrk_drake.processes.lcm_network import handle_message, listen
from dvrk_drake.processes.pace import Pace
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver
from dvrk_drake.systems.lcm.sim_dvrk_driver import apply_driver_config

#: Messages that wait for the arm, beyond which new ones are dropped; and how many are handled when a tick begins. Most
#: are handled while the arm waits for its tick, so this bounds how long a flood can delay it.
_QUEUE, _MESSAGES_A_STEP = 200, 10


def monotonic_utime() -> int:
    """Time by the computer's monotonic clock [us]."""
    return time.monotonic_ns() // 1000


def load_driver(path: str | Path) -> DvrkDriver:
    """A driver's configuration from its YAML file; what it leaves out has its default.

    Raises:
        StationError: it cannot be read, or holds something that is not allowed.
    """
    driver = load_typed_yaml(DvrkDriver, path, StationError, "a driver's configuration")
    try:
        driver.check()
    except StationError as error:
        raise StationError(f"{path}: {error}") from error
    driver.relative_to(Path(path).parent)
    return driver


def start_pose(arm: Arm, pose: Sequence[float] | None = None) -> NDArray[np.float64]:
    """The pose (n,) at which a simulated arm starts: `pose`, or the one nearest to zero that is well inside the limits.

    Raises:
        StationError: `pose` is not n numbers inside the arm's limits.
    """
    if pose is None:
        inset = 0.1 * (arm.position_upper - arm.position_lower)
        return np.clip(0.0, arm.position_lower + inset, arm.position_upper - inset)
    q = np.asarray(pose, float)
    if q.shape != (arm.num_joints,) or not np.all(np.isfinite(q)):
        raise StationError(f"a pose of {arm.name} is {arm.num_joints} finite numbers [rad, m]; got {q.tolist()}")
    if violations := arm.limit_violations(q):
        raise StationError(f"{arm.name} cannot start there: {'; '.join(violations)}")
    return q


class SimulatedArm:
    """A simulated arm with its driver, guard included, that is stepped by the wall clock."""

    def __init__(
        self,
        arm: Arm,
        driver: DvrkDriver,
        url: str,
        q: ArrayLike,
        wall_clock: Callable[[], int] = monotonic_utime,
    ) -> None:
        """On the LCM network `url`, at rest at the pose q (n,); the arm's clock starts at the time of day.

        By `wall_clock` [us] the guard lets commands expire also when this process is late or was stopped.
        """
        self.arm, self.driver, self._url = arm, driver, url
        self._ticks = 0
        self._status = b""
        self._memory = DrakeLcm("memq://")
        self._memory.Subscribe(status_channel(arm), self._keep_status)
        builder = DiagramBuilder()
        station = builder.AddSystem(ArmStation(arm))
        self._driver = apply_driver_config(
            driver,
            station,
            self._memory,
            builder,
            start_utime=time.time_ns() // 1000,
            subscribe=False,
            wall_clock=wall_clock,
        )
        self._simulator = Simulator(builder.Build())
        context = self._simulator.get_mutable_context()
        station.SetPositions(station.GetMyMutableContextFromRoot(context), q)
        self._simulator.Initialize()

    @property
    def guard(self) -> CommandGuard:
        """The guard as it is now, to be read only."""
        return self._driver.GetGuard(self._driver.GetMyContextFromRoot(self._simulator.get_context()))

    def hear(self, channel: str, data: bytes) -> None:
        """Keeps a message of the command channel for the next step."""
        self._driver.Receive(data)

    def step(self) -> None:
        """Takes what was heard and moves on by one period of the driver."""
        self._ticks += 1
        self._simulator.AdvanceTo(self._ticks * self.driver.status_period)
        self._memory.HandleSubscriptions(0)

    def stall(self, seconds: float) -> None:
        """Plays a bridge whose process is stopped for so long, of the arm's clock: neither guard nor status.

        The motors apply meanwhile what they were told last, as those of a dVRK do.
        """
        self._driver.SetStalled(True)
        for _ in range(round(seconds / self.driver.status_period)):
            self.step()
        self._driver.SetStalled(False)

    def send(self, network: lcm.LCM) -> None:
        """Tells of the state as it is now."""
        network.publish(status_channel(self.arm), self._status)

    def run(self, stopped: Callable[[], bool], tell: Callable[[str], None] = lambda line: None) -> Pace:
        """Steps by the wall clock until `stopped`, and tells of every change of the guard's state.

        A status goes out when its tick begins, and the simulation computes the next state while the controller computes
        its answer, which acts from the next tick on: as with an arm, whose motors do not wait for it.

        Returns:
            The pace, with the count of late ticks.
        """
        # Opened here, as LCM's reading thread is scheduled like the thread that opens it. Drake's own subscription
        # would keep one message between two steps; a second sender must not hide there.
        network = lcm.LCM(self._url)
        network.subscribe(command_channel(self.arm), self.hear).set_queue_capacity(_QUEUE)
        # The guard takes the time since the simulation was made for its first period, which is too long. The status of
        # that step is not sent: a controller would refuse the arm for it.
        self.step()
        self.step()
        pace = Pace(self.driver.status_period, sleep=lambda seconds: listen(network, seconds))
        told = ""
        while not stopped():
            pace.wait()
            for _ in range(_MESSAGES_A_STEP):
                if not handle_message(network, 0.0):
                    break
            self.send(network)
            self.step()
            if (state := self._describe()) != told:
                tell(f"{self._simulator.get_context().get_time():9.3f} s  {state}")
                told = state
        return pace

    def _keep_status(self, data: bytes) -> None:
        self._status = data

    def _describe(self) -> str:
        guard = self.guard
        sender = f", sender {guard.sender_id}" if guard.sender_id else ""
        return describe_state(guard.state, guard.fault_text or guard.hold_reason) + sender


def stop_on_signals() -> Callable[[], bool]:
    """Whether SIGINT or SIGTERM came since: for loops that end in order."""
    came: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: came.append(number))
    return lambda: bool(came)
