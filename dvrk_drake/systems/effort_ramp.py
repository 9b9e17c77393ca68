"""Ramp from the measured effort of an arm to the effort of a controller."""

from __future__ import annotations

from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from dvrk_drake.errors import ControllerError


class EffortRamp(LeafSystem):
    """Outputs the measured effort until it is enabled. It then changes to the desired one over `duration`.

    A command guard that accepts only efforts near the present ones receives such efforts until its arm follows. The
    effort on the arm has no step.

    .. pydrake_system::

        name: EffortRamp
        input_ports:
        - effort_wanted
        - effort_measured
        - enabled
        output_ports:
        - effort

    `effort_wanted`, `effort_measured` and `effort` have n numbers [N m; N on a prismatic joint]. `enabled` has one, 0
    or not. `effort` is start + share * (wanted - start), where start is the last measured effort before it was enabled
    and share increases from 0 to 1. Both are discrete state, updated every `period` or by a forced discrete update.
    """

    def __init__(self, num_joints: int, *, period: float = 1e-3, duration: float = 1.0) -> None:
        """Creates a ramp for `num_joints` joints with an update `period` and a `duration` of the ramp [s].

        Raises:
            ControllerError: They are not positive.
        """
        super().__init__()
        if not (period > 0 and duration > 0):
            raise ControllerError(f"period and duration must be positive; got {period}, {duration}")
        self._increment = period / duration
        self._wanted = self.DeclareVectorInputPort("effort_wanted", num_joints)
        self._measured = self.DeclareVectorInputPort("effort_measured", num_joints)
        self._enabled = self.DeclareVectorInputPort("enabled", 1)
        self._start = self.DeclareDiscreteState(num_joints)
        self._share = self.DeclareDiscreteState(1)
        self.DeclareVectorOutputPort("effort", num_joints, self._calc_effort)
        self.DeclareInitializationDiscreteUpdateEvent(self._update)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclareForcedDiscreteUpdateEvent(self._update)

    def GetShare(self, context: Context) -> float:
        """Returns the completed share of the ramp, 0..1."""
        return float(context.get_discrete_state(int(self._share)).get_value()[0])

    def _update(self, context: Context, state: DiscreteValues) -> None:
        if self._enabled.Eval(context)[0]:
            state.set_value(int(self._share), [min(1.0, self.GetShare(context) + self._increment)])
        else:
            state.set_value(int(self._share), [0.0])
            state.set_value(int(self._start), self._measured.Eval(context))

    def _calc_effort(self, context: Context, output: BasicVector) -> None:
        start = context.get_discrete_state(int(self._start)).get_value()
        output.SetFromVector(start + self.GetShare(context) * (self._wanted.Eval(context) - start))
