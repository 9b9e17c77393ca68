"""Ramp from the measured effort of an arm to the effort of a controller."""

from __future__ import annotations

from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from dvrk_drake.errors import ControllerError


class EffortRamp(LeafSystem):
    """Outputs the measured effort until the ramp is enabled. The output then changes to the desired effort.

    A command guard accepts the first commanded efforts only if they are close to the measured efforts. The ramp also
    avoids a step of the effort on the arm.

    .. pydrake_system::

        name: EffortRamp
        input_ports:
        - effort_wanted
        - effort_measured
        - enabled
        output_ports:
        - effort

    - `effort_wanted` (n): desired effort [N m; N on a prismatic joint].
    - `effort_measured` (n): measured effort.
    - `enabled` (1): 0 disables the ramp, any other value enables it.
    - `effort` (n): start + share * (effort_wanted - start). `start` is the last measured effort before the ramp was
      enabled. `share` increases linearly from 0 to 1 within `duration`.

    `start` and `share` are discrete states. They are updated every `period` seconds and by a forced discrete update.
    """

    def __init__(self, num_joints: int, *, period: float = 1e-3, duration: float = 1.0) -> None:
        """Creates a ramp.

        Args:
            num_joints: Number n of joints.
            period: Period of the update [s].
            duration: Duration of the ramp [s].

        Raises:
            ControllerError: Period or duration is not positive.
        """
        super().__init__()
        if not (period > 0 and duration > 0):
            raise ControllerError(
                f"period and duration must be positive numbers of seconds; got {period} and {duration}"
            )
        self._increment = period / duration
        self._wanted = self.DeclareVectorInputPort("effort_wanted", num_joints)
        self._measured = self.DeclareVectorInputPort("effort_measured", num_joints)
        self._enabled = self.DeclareVectorInputPort("enabled", 1)
        self._start = int(self.DeclareDiscreteState(num_joints))
        self._share = int(self.DeclareDiscreteState(1))
        self.DeclareVectorOutputPort("effort", num_joints, self._calc_effort)
        self.DeclareInitializationDiscreteUpdateEvent(self._update)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclareForcedDiscreteUpdateEvent(self._update)

    def GetShare(self, context: Context) -> float:
        """Returns the completed share of the ramp, 0..1."""
        return float(context.get_discrete_state(self._share).value()[0])

    def _update(self, context: Context, state: DiscreteValues) -> None:
        if self._enabled.Eval(context)[0]:
            state.set_value(self._share, [min(1.0, self.GetShare(context) + self._increment)])
        else:
            state.set_value(self._share, [0.0])
            state.set_value(self._start, self._measured.Eval(context))

    def _calc_effort(self, context: Context, output: BasicVector) -> None:
        start = context.get_discrete_state(self._start).value()
        share = self.GetShare(context)
        wanted = self._wanted.Eval(context)
        output.SetFromVector(wanted if share >= 1.0 else start + share * (wanted - start))
