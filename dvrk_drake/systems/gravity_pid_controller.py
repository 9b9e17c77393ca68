"""Compiled gravity compensation and PID control of one arm: equation 11 of Rutfield et al. (WPI, 2015)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem, ValueProducer

from dvrk_drake.dynamics.compiled import entry_point
from dvrk_drake.dynamics.friction_compensation import MAX_SLIP_SHARE, slip_effort
from dvrk_drake.dynamics.holding_torque import HoldingArrays
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ControllerError
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.systems.gravity_pid_step import FILTER_TIME, NUM_STATES, RATE_TIME, controller_step

#: "hold" regulates a pose, "gravity" compensates gravity and leaves the arm free to move, "damped" adds damping, and
#: "guide" adds virtual dry friction, so the arm stays where a hand leaves it.
Mode = Literal["hold", "gravity", "damped", "guide"]

#: Largest speed of the slow motion of a joint at rest [rad/s], [m/s]. A hand that rests drifts by a few mrad/s, and an
#: arm that it releases too early sinks slowly.
_REST_SPEED = 0.02, 0.002

#: Share of one encoder count that the difference of the two filters of `virtual_friction` reaches after one count: 1/e.
_COUNT_RESPONSE = 0.37

#: Distance from its place at which a spring of mode "guide" breaks away [rad], [m], in addition to 1.5 encoder counts.
#: The tremor and the drift of a hand at rest, and a slip after the release, are smaller.
_TRAVEL = 0.008, 0.0008

#: Deflection at which a spring of mode "guide" slides [rad], [m], if the next two numbers allow it. A released arm
#: should move by at most 5 mrad.
_DEFLECTION = 0.004, 0.0004

#: Largest effort of a spring or of the damping because of one encoder count, as a share of the slip effort. With an
#: exact model, both together are smaller than the dry friction, so one count cannot move a joint. At rest, the play
#: suppresses them.
_COUNT_SHARE = 0.4

#: Largest effort of the play of a spring of mode "guide", as a share of the dry friction of the joint. The dry friction
#: then dissipates at least twice the energy that the play creates.
_PLAY_SHARE = 0.5

#: Largest ratio of the stiffness of a spring of mode "guide" to the gain Kp. It doubles the bandwidth, so the phase
#: margin at the delays of the velocity filter and of the messages remains large enough.
_MAX_STIFFENING = 4.0

#: Distance that a joint cannot move in one period, in addition to three encoder counts and to the measured motion
#: [rad], [m]. The tolerances are those of the guard for a jump of the position.
_JUMP = 0.01, 0.001

Vector = NDArray[np.float64]

_MODES: tuple[Mode, ...] = get_args(Mode)


class GravityPidController(LeafSystem):
    """Compensates gravity and, in "hold" mode, regulates the arm's pose.

    The control law is tau = G(q) + Kp e + Kd de + integral(Ki e dt), with e = q_d - q and de = v_d - v for every joint.
    It is equation 11 of Rutfield et al. (WPI, 2015). G(q) is the predicted holding torque of the model: gravity,
    cables, springs and offsets. The holding torque of each joint is multiplied by its feedforward scale. The gain
    matrices are diagonal. In "gravity" mode tau = G(q). In "damped" mode tau = G(q) - Kd v, so an error of G causes a
    slow motion that does not accelerate.

    **Guide.** In "guide" mode, virtual dry friction is added to G(q), so the arm stays where a hand leaves it, although
    G(q) has an error and the friction of the arm relaxes. When a joint has moved slower than 20 mrad/s for about 0.3 s,
    apart from the tremor of a hand, a spring attaches at its position, without a step of the effort. Its stiffness is
    Kp, or up to four times as large if it would otherwise deflect by more than 4 mrad. The spring holds the joint up to
    its slip effort, at which it slides. It breaks away 8 mrad from its place, or when a hand moves two joints faster
    than 50 mrad/s, and the joint is free until it rests again. Each spring is passive: it returns at most the energy
    with which the hand deflected it. Damping acts in addition. On a free joint, it acts up to the error of the model,
    and only below 50 mrad/s. At the change from "hold" mode, the springs take over the effort of the regulator, up to
    the slip effort. All springs detach if a measurement is not valid, if the position jumps, and in all other modes.
    Their efforts then decay with a time constant of 20 ms.

    .. pydrake_system::

        name: GravityPidController
        input_ports:
        - state_estimated
        - desired_state (optional)
        output_ports:
        - effort
        - gravity_effort
        - fault

    Ports, for n joints in the arm's order [rad, rad/s, N m; m, m/s, N on a prismatic joint]:

    - `state_estimated` (2n): q, then v. Not connected: ControllerError at initialization.
    - `desired_state` (2n): q_d, then v_d, used only in "hold" mode. Unconnected: "hold" mode regulates the pose
      measured at initialization, at the change to "hold", or at the end of a fault, whichever was last.
    - `effort` (n): commanded effort inside the effort limits.
    - `gravity_effort` (n): G(q) alone, not clamped to the effort limits.
    - `fault` (1): 1 while a number in `state_estimated` is not finite or its magnitude exceeds 1e6, else 0. In "hold"
      mode, `desired_state` is checked as well.

    **Time.** Inputs are sampled and outputs change every `period` seconds and at initialization. Initialization also
    resets the integrator and stores the pose to regulate. If the plant of an ArmStation has the same period, the
    command acts one period later, as on hardware. In a plant with sampled output ports (Drake's default), the plant
    steps first, so there is no delay. A loop that is driven by messages can use a forced discrete update, which
    executes the same step. Gains and mode are numeric parameters of the Context and can be changed while running.

    **Saturation.** `effort` is clamped to the effort limits. Conditional integration prevents integrator windup (Astrom
    and Hagglund, Advanced PID Control, 2006, chapter 3). The integrator of a joint stops while the command exceeds the
    limit and the integration would increase the excess. The integrator also stops while the magnitude of Kp e alone
    exceeds the limit. The integral is stored as an effort, so a change of Ki causes no step of the effort. Ki = 0
    resets the integral.

    **Fault.** An invalid input sets `fault` and does not raise an exception, so the Diagram continues to run. While an
    input is invalid, the command is the gravity effort of the last valid pose, without PID. The arm then neither falls
    nor moves to another pose. Before the first valid pose, the command is zero. Regulation resumes automatically, with
    the integrator at zero, when the inputs are valid again.

    To compensate gravity without an identified model, use the model of the arm's SDF, as in the example.

    Example:
        >>> import dvrk_drake as dvrk
        >>> model = dvrk.IdentifiedModel.from_arm(dvrk.load_arm("mtml"))
        >>> controller = dvrk.GravityPidController(model, mode="gravity")
        >>> context = controller.CreateDefaultContext()
        >>> controller.SetMode(context, "damped")
        >>> controller.GetMode(context)
        'damped'
    """

    def __init__(
        self,
        model: IdentifiedModel,
        *,
        period: float = 1e-3,
        gains: Gains | None = None,
        mode: Mode = "hold",
        effort_limits: ArrayLike | None = None,
        slip_efforts: ArrayLike | None = None,
    ) -> None:
        """Creates the controller for the model's arm.

        Args:
            model: Model that defines G(q). Its parameters are copied.
            period: Period of the update [s].
            gains: Gains with n numbers each. None: the gains of the arm.
            mode: Initial mode: "hold", "gravity", "damped" or "guide".
            effort_limits: Largest magnitude (n,) [N m, N] of each joint's effort. None: the limits of the arm.
            slip_efforts: Efforts (n,) [N m, N] up to which the virtual friction of mode "guide" holds the joints, at
                most `MAX_SLIP_SHARE` times the effort limits of the arm. None: `slip_effort` of the model.

        Raises:
            ModelError: The model is not valid for its arm.
            ArmError: The arm of the model has locked joints.
            ControllerError: A period, gain, mode, limit or slip effort is invalid.
        """
        super().__init__()
        model.check()
        arm = model.arm
        arm.refuse_locked_joints("a controller")
        self._arm = arm
        n = arm.num_joints
        limits = np.asarray(arm.effort_limits if effort_limits is None else effort_limits, float)
        if limits.shape != (n,) or not np.all(limits > 0):
            raise ControllerError(f"effort_limits must be {n} positive numbers; got {limits.tolist()}")
        if not (np.isfinite(period) and period > 0):
            raise ControllerError(f"period must be a positive number of seconds; got {period}")
        self._period = float(period)
        slip = np.asarray(slip_effort(model) if slip_efforts is None else slip_efforts, float)
        if slip.shape != (n,) or not np.all((slip >= 0) & (slip <= MAX_SLIP_SHARE * arm.effort_limits)):
            allowed = f"0 to {MAX_SLIP_SHARE:g} times the effort limits {(MAX_SLIP_SHARE * arm.effort_limits).tolist()}"
            raise ControllerError(f"slip_efforts must be {n} numbers; allowed: {allowed}; got {slip.tolist()}")

        self.DeclareVectorInputPort(name="state_estimated", size=2 * n)
        self.DeclareVectorInputPort(name="desired_state", size=2 * n)
        gains = gains or arm.gains
        self._check_gains(gains)
        self._gains = [self.DeclareNumericParameter(BasicVector(k)) for k in (gains.kp, gains.kd, gains.ki)]
        self._slip = self.DeclareNumericParameter(BasicVector(slip))
        self._mode = self.DeclareNumericParameter(BasicVector([self._mode_number(mode)]))
        # The states have the order of the arguments of the compiled step. NaN means that there is no pose yet.
        effort, gravity_effort, fault, *_ = (
            self.DeclareDiscreteState(BasicVector(np.full(size, value)))
            for size, value in [
                (n, 0.0),
                (n, 0.0),
                (1, 0.0),
                (n, 0.0),
                (n, np.nan),
                (n, np.nan),
                (NUM_STATES * n, 0.0),
            ]
        )
        self.DeclareStateOutputPort(name="effort", state_index=effort)
        self.DeclareStateOutputPort(name="gravity_effort", state_index=gravity_effort)
        self.DeclareStateOutputPort(name="fault", state_index=fault)
        counts = arm.encoder_counts()
        rest = FILTER_TIME * arm.per_joint(*_REST_SPEED) + _COUNT_RESPONSE * counts
        jump = arm.per_joint(*_JUMP) + 3.0 * counts
        self._constants = np.array([model.feedforward_scale, limits, rest, jump])
        # Reading one cache entry at each update is faster than reading each parameter.
        self._settings = self.DeclareCacheEntry(
            "settings",
            ValueProducer(allocate=lambda: AbstractValue.Make((np.zeros((13, n)), 0)), calc=self._calc_settings),
            {self.all_parameters_ticket()},
        )
        holding = model.static_model.with_parameters(model.theta)
        update = self._make_update(holding, restart=False)
        restart = self._make_update(holding, restart=True)
        self.DeclareInitializationDiscreteUpdateEvent(update=restart)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec=self._period, offset_sec=0.0, update=update)
        self.DeclareForcedDiscreteUpdateEvent(update=update)

    @property
    def period(self) -> float:
        """Period of the update [s]."""
        return self._period

    def SetGains(self, context: Context, gains: Gains) -> None:
        """Changes the gains from the next update on.

        Raises:
            ControllerError: A gain is not valid for this arm; see `Arm.gains_fault`.
        """
        self._check_gains(gains)
        for index, values in zip(self._gains, (gains.kp, gains.kd, gains.ki), strict=True):
            context.get_mutable_numeric_parameter(index).SetFromVector(values)

    def GetGains(self, context: Context) -> Gains:
        """Returns the gains in use."""
        return Gains(*(context.get_numeric_parameter(index).get_value().tolist() for index in self._gains))

    def SetMode(self, context: Context, mode: Mode) -> None:
        """Changes the mode from the next update on.

        Raises:
            ControllerError: The mode is not one of `Mode`.
        """
        context.get_mutable_numeric_parameter(self._mode).SetAtIndex(0, self._mode_number(mode))

    def GetMode(self, context: Context) -> Mode:
        """Returns the mode in use."""
        return _MODES[int(context.get_numeric_parameter(self._mode).GetAtIndex(0))]

    def _check_gains(self, gains: Gains) -> None:
        if fault := self._arm.gains_fault(gains):
            raise ControllerError(fault)

    @staticmethod
    def _mode_number(mode: Mode) -> float:
        if mode not in _MODES:
            raise ControllerError(f'unknown mode "{mode}"; known modes: {", ".join(_MODES)}')
        return float(_MODES.index(mode))

    def _calc_settings(self, context: Context, settings: AbstractValue) -> None:
        per_joint = [context.get_numeric_parameter(index).get_value() for index in (*self._gains, self._slip)]
        mode = int(context.get_numeric_parameter(self._mode).GetAtIndex(0))
        settings.set_value((np.vstack([per_joint, self._constants, *self._springs(*per_joint)]), mode))

    def _springs(self, kp: Vector, kd: Vector, ki: Vector, slip: Vector) -> tuple[Vector, ...]:
        """Returns stiffness, travel and damping of the springs of mode "guide", damping of a free joint, and play.

        A spring reaches the slip effort before it breaks away. Without the dry friction, the slip effort is the error
        of the model, which lets a free joint drift.
        """
        counts = np.maximum(self._arm.encoder_counts(), np.finfo(float).tiny)
        deflection = self._arm.per_joint(*_DEFLECTION)
        stiffness = np.clip(slip / np.maximum(deflection, counts / _COUNT_SHARE), kp, _MAX_STIFFENING * kp)
        damping = np.sqrt(np.divide(stiffness, kp, out=np.ones_like(kp), where=kp > 0)) * kd
        damping = np.minimum(damping, _COUNT_SHARE * slip * RATE_TIME / counts)
        dry = self._arm.dry_friction()
        compliance = np.divide(1.0, stiffness, out=np.zeros_like(stiffness), where=stiffness > 0)
        travel = np.maximum(self._arm.per_joint(*_TRAVEL) + 1.5 * counts, compliance * slip)
        play = np.minimum(0.5 * counts, _PLAY_SHARE * compliance * dry)
        return stiffness, travel, damping, np.maximum(slip - dry, 0.0), play

    def _make_update(self, holding: HoldingArrays, restart: bool) -> Callable[[Context, DiscreteValues], None]:
        """Returns the handler of an update event.

        The handler runs between two steps of the plant, which evict Python's data from the processor caches. For speed,
        it accesses few objects, by local names.
        """
        eval_vector_input, settings, period = self.EvalVectorInput, self._settings, self._period
        step = entry_point(controller_step)

        def update(context: Context, discrete_state: DiscreteValues) -> None:
            measured = eval_vector_input(context, 0)
            if measured is None:
                raise ControllerError("input port state_estimated is not connected")
            state = measured.get_value()
            desired = eval_vector_input(context, 1)
            per_joint, mode = settings.Eval(context)
            group = discrete_state.get_mutable_value
            step(
                state,
                state if desired is None else desired.get_value(),
                desired is not None,
                restart,
                period,
                mode,
                per_joint,
                holding,
                group(0),
                group(1),
                group(2),
                group(3),
                group(4),
                group(5),
                group(6),
            )

        return update
