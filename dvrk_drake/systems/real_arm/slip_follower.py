"""Where the springs of dry friction are hooked on."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numba
import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from dvrk_drake.dynamics.actuator_effects import EFFECT_KINDS, effect_step
from dvrk_drake.systems.gravity_pid_step import entry_point
from dvrk_drake.systems.real_arm.dry_friction import Slider


class SlipFollower(LeafSystem):
    """Keeps, for each slider of `add_friction`, the position at which its spring has no load.

    .. pydrake_system::

        name: SlipFollower
        input_ports:
        - plant_state
        output_ports:
        - desired_state

    - `plant_state`: of the plant that the sliders are part of.
    - `desired_state`: for the plant's port of that name and the arm's instance: positions, then velocities (zero) of
      all its actuators.

    A hook stands still while its spring is stretched by less than its travel, and follows at that distance when it is
    stretched further: `ActuatorEffect.step` of "presliding". The spring is taken at the end of a step by the plant and
    the hook moves after it, always to less stretch: what a slider has taken is never less than what its spring holds.
    At initialization all springs are slack.
    """

    def __init__(
        self, plant: MultibodyPlant, instance: ModelInstanceIndex, sliders: Sequence[Slider], time_step: float
    ) -> None:
        """Of a finalized plant; the update has the plant's `time_step` [s]."""
        super().__init__()
        columns = [actuator.joint().position_start() for actuator in (slider.actuator for slider in sliders)]
        order = list(plant.GetJointActuatorIndices(instance))
        self._columns = np.array(columns, dtype=int)
        self._entries = np.array([order.index(slider.actuator.index()) for slider in sliders], dtype=int)
        self._travel = np.array([slider.travel for slider in sliders])
        self.DeclareVectorInputPort(name="plant_state", size=plant.num_multibody_states())
        state = self.DeclareDiscreteState(num_state_variables=2 * len(order))
        self.DeclareStateOutputPort(name="desired_state", state_index=state)
        self.DeclareInitializationDiscreteUpdateEvent(update=self._slacken)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec=time_step, offset_sec=0.0, update=self._make_follow())

    def _slacken(self, context: Context, discrete_state: DiscreteValues) -> None:
        hooks = discrete_state.get_mutable_value()
        hooks[self._entries] = self.EvalVectorInput(context, 0).get_value()[self._columns]

    def _make_follow(self) -> Callable[[Context, DiscreteValues], None]:
        """The handler of the update, with all that it needs at hand: see GravityPidController."""
        eval_vector_input, step = self.EvalVectorInput, entry_point(_follow_all)
        columns, entries, travel = self._columns, self._entries, self._travel

        def follow(context: Context, discrete_state: DiscreteValues) -> None:
            hooks = discrete_state.get_mutable_value()
            step(eval_vector_input(context, 0).get_value(), columns, entries, travel, hooks)

        return follow


_PRESLIDING = EFFECT_KINDS["presliding"].code


@numba.njit("void(float64[::1], int64[::1], int64[::1], float64[::1], float64[::1])", cache=True)
def _follow_all(state, columns, entries, travel, hooks):
    for i in range(len(columns)):
        position = state[columns[i]]
        stretch = position - hooks[entries[i]]
        if abs(stretch) > travel[i]:
            # A spring that starts slack and is stretched that far has the element's state.
            z, _ = effect_step(_PRESLIDING, 0.0, stretch, 0.0, travel[i])
            hooks[entries[i]] = position - z * travel[i]
