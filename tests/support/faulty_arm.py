"""Simulated arm with sensor faults, with its driver and a controller."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.driver import DvrkDriver
from dvrk_drake.systems.hand import Hand, HandPath
from dvrk_drake.systems.lcm.messages import make_command
from dvrk_drake.systems.lcm.sim_dvrk_driver import SimDvrkDriver

PERIOD = 1e-3
#: Initial time for which the desired pose is constant, while the guard observes the controller [s].
_AT_REST = 0.8

#: Sensor faults of one joint: (q, v, effort, q at the start of the fault, time since the start, scale) -> measurement.
#: The scale is 1 for a revolute joint [rad] and 0.1 for a prismatic joint [m].
FAULTS = {
    "encoder stuck": lambda q, v, effort, q0, t, scale: (q0, 0.0, effort),
    "position stuck": lambda q, v, effort, q0, t, scale: (q0, v, effort),
    "position jumps": lambda q, v, effort, q0, t, scale: (q + 0.3 * scale, v, effort),
    "position drifts": lambda q, v, effort, q0, t, scale: (q + 0.5 * scale * t, v, effort),
    "encoder inverted": lambda q, v, effort, q0, t, scale: (2 * q0 - q, -v, effort),
    "velocity inverted": lambda q, v, effort, q0, t, scale: (q, -v, effort),
    "velocity zero": lambda q, v, effort, q0, t, scale: (q, 0.0, effort),
    "velocity offset": lambda q, v, effort, q0, t, scale: (q, v + scale, effort),
    "effort zero": lambda q, v, effort, q0, t, scale: (q, v, 0.0),
    "effort not finite": lambda q, v, effort, q0, t, scale: (q, v, np.nan),
    "not finite": lambda q, v, effort, q0, t, scale: (np.nan, v, effort),
}


class FaultySensors(LeafSystem):
    """Sensors that forward the state (2n) and effort (n). The measurement of one joint fails from a given time on.

    Attributes:
        fault, joint, begin: Fault of `FAULTS`, joint, and time of its begin [s].
        delays: Additional delays (n,) of position and velocity, in periods. Their largest value is MAX_DELAY.
    """

    MAX_DELAY = 100

    def __init__(self, arm):
        super().__init__()
        n = arm.num_joints
        self.fault, self.joint, self.begin, self._q = None, 0, np.inf, None
        self._scale = arm.per_joint(1.0, 0.1)
        self.delays, self._states = np.zeros(n, int), np.full((self.MAX_DELAY + 1, 2 * n), np.nan)
        state, effort = self.DeclareVectorInputPort("state", 2 * n), self.DeclareVectorInputPort("effort", n)
        self.DeclareVectorOutputPort("state_measured", 2 * n, lambda c, out: out.SetFromVector(self.measure(c)[0]))
        self.DeclareVectorOutputPort("effort_measured", n, lambda c, out: out.SetFromVector(self.measure(c)[1]))
        self._ports = state, effort

    def measure(self, context):
        state, effort = (np.array(port.Eval(context)) for port in self._ports)
        t, j, n = context.get_time(), self.joint, len(effort)
        tick = round(t / PERIOD)
        self._states[tick % len(self._states)] = state
        if self.delays.any():
            rows = (tick - np.minimum(self.delays, tick)) % len(self._states)
            state = self._states[np.tile(rows, 2), np.arange(2 * n)]
        if t >= self.begin:
            self._q = state[j] if self._q is None else self._q
            state[j], state[n + j], effort[j] = FAULTS[self.fault](
                state[j], state[n + j], effort[j], self._q, t - self.begin, self._scale[j]
            )
        return state, effort


def wave(arm, seconds, speed, seed=0, reach=0.35, center=None):
    """Returns a smooth trajectory of the positions (n), which starts at rest at `center`.

    None: the center is in the middle of the joint ranges.

    The amplitude is `reach` times half of the range, or less if the speed would exceed `speed` [rad/s] (`speed` / 10
    [m/s] for prismatic joints). Each joint has its own frequency.
    """
    times = np.arange(0.0, seconds + 0.1, 0.02)
    middle, half = 0.5 * (arm.position_upper + arm.position_lower), 0.5 * (arm.position_upper - arm.position_lower)
    for limit in arm.coupled_limits:
        row = np.array([limit.coefficients.get(name, 0.0) for name in arm.joint_names])
        middle = middle + row / (row @ row) * (0.5 * (limit.lower + limit.upper) - row @ middle)
        half = np.where(row != 0, np.minimum(half, 0.5 * (limit.upper - limit.lower)), half)
    middle = middle if center is None else center
    omega = np.random.default_rng(seed).uniform(1.0, 2.5, arm.num_joints)
    amplitude = np.minimum(reach * half, speed * arm.per_joint(1.0, 0.1) / omega)
    fade = np.clip((times - _AT_REST) / 1.5, 0.0, 1.0)
    q = middle + (fade**2 * (3 - 2 * fade))[:, None] * amplitude * np.sin(np.outer(times, omega))
    return PiecewisePolynomial.CubicWithContinuousSecondDerivatives(times, q.T, True)


@dataclass
class Outcome:
    """Effect of a sensor fault of one joint on the simulated arm.

    Attributes:
        detected: Time from the fault to its detection [s]; inf if it was not detected.
        text: Fault text of the guard.
        before, after: Largest displacement of the joint before and after the detection of the fault [rad, m].
        speed: Largest speed (n,) of each joint at least 50 ms after detection [rad/s, m/s].
        effort: Largest effort of any joint at least 50 ms after detection, as a fraction of its limit.
    """

    detected: float
    text: str
    before: float
    after: float
    speed: np.ndarray
    effort: float


class FaultyArm:
    """Diagram of an arm, its driver and a controller, advanced in steps of 1 ms.

    Attributes:
        sensors: Sensors with adjustable faults.
        model: Ground-truth model.
        desired: Function from time to the desired state (2n) of the arm under "effort" and "position".
        on_status: Function from status and time to the desired state for `ArmController.answer`.
        controller: ArmController, or None.
    """

    def __init__(self, name, use, *, path=None, hand=False, effects=True, driver=None, seed=0):
        """Creates an arm at rest at the start of its path.

        Args:
            use: "effort" (PID and gravity along the path), "gravity", "damped" or "guide" (gravity compensation),
                "position", "hold" (no commands).
            path: PiecewisePolynomial of the joints; a wave of 8 s at 0.5 rad/s by default.
            hand: Whether an operator moves the arm along the path.
        """
        self.arm = arm = load_arm(name)
        known = arm.effects.cables + arm.effects.springs if effects else []
        self.model = model = IdentifiedModel.from_arm(arm, known)
        builder = DiagramBuilder()
        effects = arm.effects if effects else None
        self.station = builder.AddSystem(ArmStation(arm, effects=effects, seed=seed))
        self.driver = builder.AddSystem(SimDvrkDriver(arm, driver or DvrkDriver(), model=model))
        self.sensors = builder.AddSystem(FaultySensors(arm))
        connect = builder.Connect
        for port, measured in (("state", "state_estimated"), ("effort", "effort_measured")):
            connect(self.station.GetOutputPort(f"{arm.name.lower()}.{measured}"), self.sensors.GetInputPort(port))
        state, effort = (self.sensors.GetOutputPort(port) for port in ("state_measured", "effort_measured"))
        connect(state, self.driver.GetInputPort("state_estimated"))
        connect(effort, self.driver.GetInputPort("effort_measured"))
        connect(
            self.driver.GetOutputPort("effort_commanded"),
            self.station.GetInputPort(f"{arm.name.lower()}.effort_commanded"),
        )
        path = path or wave(arm, 8.0, 0.5, seed)
        self.start = path.value(0.0).ravel()
        velocity = path.MakeDerivative()
        self.desired = lambda t: np.concatenate([path.value(t), velocity.value(t)]).ravel()
        self.controller = None
        self.on_status = lambda status, time: self.desired(time) if use == "effort" else None
        if use in ("effort", "gravity", "damped", "guide"):
            self.controller = ArmController(arm, model, "hold" if use == "effort" else use, PERIOD)
        self._use = use
        if hand:
            hands, wanted = builder.AddSystem(Hand(arm)), builder.AddSystem(HandPath(arm, "dh_7", path))
            connect(self.station.GetOutputPort(f"{arm.name.lower()}.state_true"), hands.GetInputPort("state_estimated"))
            connect(wanted.get_output_port(), hands.GetInputPort("X_BG_desired"))
            push = self.station.GetInputPort(f"{arm.name.lower()}.effort_disturbance")
            connect(hands.GetOutputPort("effort_disturbance"), push)
        self.simulator = Simulator(builder.Build())
        self.context = self.simulator.get_mutable_context()
        self.station.SetPositions(self.station.GetMyMutableContextFromRoot(self.context), self.start)
        self.simulator.Initialize()
        self.ticks = 0

    @property
    def guard(self):
        return self.driver.GetGuard(self.driver.GetMyContextFromRoot(self.context))

    def step(self):
        time = PERIOD * self.ticks
        status = self.driver.GetOutputPort("lcmt_dvrk_status").Eval(self.driver.GetMyContextFromRoot(self.context))
        if self.controller is not None:
            self.driver.Receive(self.controller.answer(status, time, self.on_status(status, time)).encode())
        elif self._use == "position":
            mode, desired = Command.POSITION, self.desired(time)
            command = make_command(status, 1, round(1e6 * time), mode, desired_state=desired)
            self.driver.Receive(command.encode())
        self.ticks += 1
        self.simulator.AdvanceTo(PERIOD * self.ticks)

    def state(self):
        port = self.station.GetOutputPort(f"{self.arm.name.lower()}.state_true")
        return np.split(np.array(port.Eval(self.station.GetMyContextFromRoot(self.context))), 2)

    def effort(self):
        port = self.driver.GetOutputPort("effort_commanded")
        return np.array(port.Eval(self.driver.GetMyContextFromRoot(self.context)))

    def fail(self, fault, joint, at, seconds=1.5, patience=3.0):
        """Runs until `at` [s], makes the measurement of a joint fail, and returns the Outcome."""
        while self.ticks * PERIOD < at:
            self.step()
        assert self.guard.state != Status.STATE_FAULT, self.guard.fault_text
        self.sensors.fault, self.sensors.joint, self.sensors.begin = fault, joint, self.ticks * PERIOD
        start, before, ended = self.state()[0][joint], 0.0, self.ticks
        while self.guard.state != Status.STATE_FAULT and (self.ticks - ended) * PERIOD < patience:
            self.step()
            before = max(before, abs(self.state()[0][joint] - start))
        if self.guard.state != Status.STATE_FAULT:
            return Outcome(np.inf, "", before, 0.0, np.zeros(self.arm.num_joints), 0.0)
        detected, found = (self.ticks - ended) * PERIOD, self.state()[0][joint]
        after, speed, effort = 0.0, np.zeros(self.arm.num_joints), 0.0
        for k in range(round(seconds / PERIOD)):
            self.step()
            q, v = self.state()
            after = max(after, abs(q[joint] - found))
            if k >= 50:
                effort = max(effort, np.max(np.abs(self.effort()) / self.arm.effort_limits))
                speed = np.maximum(speed, np.abs(v))
        return Outcome(detected, self.guard.fault_text, before, after, speed, effort)
