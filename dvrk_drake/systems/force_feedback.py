"""Force feedback to the master of a teleoperation: reflects the estimated force on the follower, and stays passive."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RotationMatrix
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from dvrk_drake.dynamics.kinematics import Contact
from dvrk_drake.errors import ControllerError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import IMPLAUSIBLE

#: Energy in the tank when the clutch closes, and largest energy in the tank [J]. The former is 3 N over 17 mm, so the
#: handle cannot move a hand far. The latter is 3 N over 170 mm, so most of what a spring has stored is returned.
START_ENERGY, MAX_ENERGY = 0.05, 0.5
#: Damping at the handle while the tank is empty [N s/m]. A hand's own damping is larger, see `Grip`.
DAMPING = 10.0
#: Largest speed of the handle with feedback [m/s]. Hands of operators seldom reach 0.5 m/s.
MAX_SPEED = 2.0
#: Time in which the force can rise from 0 to its limit [s], so that a component that becomes measurable causes no jerk.
RISE_TIME = 0.05
#: Largest effort of the feedback, as a share of the effort limits. The other half remains for gravity, so that the
#: limits of the arm do not change the feedback, whose energy is counted.
MAX_SHARE = 0.5
#: Largest age of the follower's measurement [s]. Commands expire after the same time.
MAX_AGE = 0.05


class ForceFeedback(LeafSystem):
    """Reflects the estimated force at the follower's tip to the master's handle, with a passive port at the handle.

    .. pydrake_system::

        name: ForceFeedback
        input_ports:
        - master_state
        - force
        - measurable
        - fault
        - engaged
        - following
        - measurement_age (optional)
        output_ports:
        - effort
        - energy
        - active

    Ports, for a master with n joints [rad, rad/s, N m; m, m/s, N on a prismatic joint]:

    - `master_state` (2n): q, then v.
    - `force` (3), `measurable` (3), `fault` (1): ports of the follower's `ExternalForceEstimator`, in base axes.
    - `engaged` (1), `following` (1): input and output of `Teleoperation`.
    - `measurement_age` (1): age of the follower's measurement [s]. Unconnected: 0.
    - `effort` (n): efforts to add to those of the master's controller.
    - `energy` (1): energy in the tank [J].
    - `active` (1): 1 while the force is reflected, else 0.

    **Force.** The force at the handle is gain R_FM' f. A component that cannot be measured counts as 0. A force below
    the dead zone is not reflected, and a larger one is reduced by the dead zone. The result is limited to `max_force`,
    and rises to it in 50 ms at the fastest.

    **Passivity.** The energy that the feedback has taken from the operator is counted exactly, as the sum of
    -effort' (change of q), because the effort is constant over a period (Hannaford and Ryu, IEEE Trans. Robotics and
    Automation 18, 2002). It is stored in a tank (Franken et al., IEEE Trans. Robotics 27, 2011). The force is reduced
    so that the tank has enough energy for the efforts of two periods at a speed of 2 m/s. Therefore the feedback never
    gives more energy to the operator than it has received, plus 0.05 J each time that the clutch closes. This holds for
    any model, follower, object and delay. If the tank becomes empty, additional damping of the handle fills it.

    **Off.** The effort becomes 0 at once, and remains 0 until the clutch opens, after any of these events: an input is
    not valid, the estimator has a fault, the measurement is older than 50 ms, the follower stops following, or the
    handle is faster than 2 m/s.

    Inputs are sampled and outputs change every `period` seconds and at initialization, which resets the state.

    Example:
        >>> import dvrk_drake as dvrk
        >>> feedback = dvrk.ForceFeedback(dvrk.load_arm("mtml"), gain=0.5)
        >>> feedback.GetOutputPort("effort").size()
        7
    """

    def __init__(
        self,
        master: Arm,
        *,
        gain: float = 1.0,
        max_force: float = 3.0,
        dead_zone: float = 0.5,
        R_FM: RotationMatrix | None = None,
        period: float = 1e-3,
    ) -> None:
        """Creates the system.

        Args:
            master: Arm that the operator moves.
            gain: Ratio of the force at the handle to the force at the tip, above 0 and at most 5.
            max_force: Largest force at the handle [N], above 0 and at most 10.
            dead_zone: Size of the force at the tip that is not reflected [N], 0 to 10. Choose it above the error of the
                estimate without a contact.
            R_FM: Rotation from the master's base to the follower's base; see `Teleoperation`.
            period: Period of the update [s].

        Raises:
            ControllerError: A number is out of range.
        """
        super().__init__()
        for name, value, low, high in (
            ("gain", gain, 0.0, 5.0),
            ("max_force", max_force, 0.0, 10.0),
            ("period", period, 0.0, 0.01),
        ):
            if not low < value <= high:
                raise ControllerError(f"{name} must be above {low:g} and at most {high:g}; got {value:g}")
        if not 0.0 <= dead_zone <= 10.0:
            raise ControllerError(f"dead_zone must be from 0 to 10 N; got {dead_zone:g}")
        self._gain, self._max_force, self._dead_zone, self._period = gain, max_force, dead_zone, period
        self._handle, self._R_FM = Contact(master), R_FM or RotationMatrix()
        self._max_effort = MAX_SHARE * master.effort_limits
        n = self._n = master.num_joints
        sizes = {"master_state": 2 * n, "force": 3, "measurable": 3, "fault": 1, "engaged": 1, "following": 1}
        for name, size in sizes.items():
            self.DeclareVectorInputPort(name, size)
        self._required = tuple(sizes)
        self._age = self.DeclareVectorInputPort("measurement_age", 1)
        indices = [self.DeclareDiscreteState(size) for size in (n, 1, 1, n, n, 3, 2)]
        for name, index in zip(("effort", "energy", "active"), indices, strict=False):
            self.DeclareStateOutputPort(name, index)
        self.DeclareInitializationDiscreteUpdateEvent(self._restart)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclareForcedDiscreteUpdateEvent(self._update)

    def _restart(self, context: Context, state: DiscreteValues) -> None:
        for k in range(state.num_groups()):
            state.get_mutable_value(k)[:] = 0.0
        state.get_mutable_value(_POSITION)[:] = np.nan
        self._update(context, state)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        groups = [state.get_mutable_value(k) for k in range(state.num_groups())]  # views
        effort, energy, active, position, acting, force, (mode, size_before) = groups
        values = [self._read(context, name) for name in self._required]
        measured, f_F, measurable, fault, engaged, following = values
        q, v = np.split(measured, 2)
        # The effort of the update before the last one acted since the last update.
        if _is_valid(q) and _is_valid(position):
            energy[0] = min(energy[0] - acting @ (q - position), MAX_ENERGY)
        position[:], acting[:] = q, effort
        is_valid = all(map(_is_valid, values)) and fault[0] < 0.5 and self._read_age(context) <= MAX_AGE
        J = self._handle.jacobian(q) if _is_valid(q) else np.zeros((3, self._n))
        is_valid = is_valid and bool(np.linalg.norm(J @ v) <= MAX_SPEED)
        mode = self._next_mode(mode, is_valid, engaged[0] > 0.5, following[0] > 0.5)
        active[0], groups[_MODE][:] = float(mode == _ON), (mode, 0.0)
        if mode == _OPEN:
            energy[0] = START_ENERGY
        if mode != _ON:
            force[:], effort[:] = 0.0, 0.0
            return
        self._reflect(np.where(measurable > 0.5, f_F, 0.0), force)
        empty = 1.0 - min(max(energy[0], 0.0) / START_ENERGY, 1.0)
        at_handle = force - empty * DAMPING * (J @ v)
        # Energy that remains if the handle moves along the effort that acts already, at the largest speed.
        reserve = max(energy[0] - self._period * MAX_SPEED * size_before, 0.0)
        size = float(np.linalg.norm(at_handle))
        tau = J.T @ at_handle
        share = float(np.max(np.abs(tau) / self._max_effort))
        shares = (1.0, reserve / max(self._period * MAX_SPEED * size, 1e-12), 1.0 / max(share, 1e-12))
        effort[:], groups[_MODE][1] = min(shares) * tau, min(shares) * size

    @staticmethod
    def _next_mode(mode: float, is_valid: bool, is_engaged: bool, follows: bool) -> float:
        """Returns the mode after an update. Only an open clutch ends the mode off."""
        if not is_engaged:
            return _OPEN
        if not is_valid or (mode == _ON and not follows) or mode == _OFF:
            return _OFF
        return _ON if follows else _OPEN

    def _reflect(self, f_F: NDArray[np.float64], force: NDArray[np.float64]) -> None:
        """Moves the force at the handle towards that at the tip (3,), with dead zone, limit and rise time."""
        size = float(np.linalg.norm(f_F))
        wanted = np.zeros(3)
        if size > self._dead_zone:
            length = min(self._gain * (size - self._dead_zone), self._max_force)
            wanted = self._R_FM.inverse() @ (length / size * f_F)
        step = wanted - force
        largest = self._max_force * self._period / RISE_TIME
        force += step * min(1.0, largest / max(float(np.linalg.norm(step)), 1e-12))

    def _read(self, context: Context, name: str) -> NDArray[np.float64]:
        port = self.GetInputPort(name)
        if not port.HasValue(context):
            raise ControllerError(f"input port {name} is not connected")
        return np.asarray(port.Eval(context))

    def _read_age(self, context: Context) -> float:
        return float(self._age.Eval(context)[0]) if self._age.HasValue(context) else 0.0


_OPEN, _ON, _OFF = 0.0, 1.0, 2.0  # clutch open, force reflected, off until the clutch opens
_POSITION, _MODE = 3, 6  # indices of discrete state groups


def _is_valid(values: NDArray[np.float64]) -> bool:
    return bool(np.all(np.abs(values) < IMPLAUSIBLE))  # false for NaN
