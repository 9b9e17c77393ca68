"""What explains an arm's efforts in a motion, column by column, behind the filter that the efforts are behind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.signals.motion_grid import MotionGrid
from dvrk_drake.dynamics.actuator_effects import (
    ActuatorEffect,
    distinct_coordinates,
    effect_fault,
    position_along,
    slides,
    spring_over,
)
from dvrk_drake.dynamics.base_parameters import independent_columns
from dvrk_drake.dynamics.dynamic_model import effect_shapes
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm

#: Widths of the smoothed sign, as shares of the coordinate's standard deviation of speed.
COULOMB_WIDTHS = (0.03, 0.1, 0.4)
#: The same width for friction that differs by direction or is more at low speeds.
DIRECTION_WIDTH = 0.1
ASYMMETRIC = "asymmetric friction"
#: What an arm's file can say of a drive -> periods a turn of a sine and a cosine.
NAMED_EFFECTS = {"spring": 0.0, "cable 1": 1.0, "cable 2": 2.0, ASYMMETRIC: 0.0}


@dataclass(frozen=True, eq=False)
class DynamicColumns:
    """tau ~ rigid (base phi) + effects c, at r rows behind the filter, actuator by actuator.

    Attributes:
        tau: (r, n) measured efforts of the actuators.
        base: (b, p) base parameters of the rigid bodies, whatever gravity's direction, from all p of them: links first,
            then one rotor an actuator.
        rigid: (r, n, b) of the base parameters.
        tilts: (2, r, n, b) derivative of `rigid` by the x and y component of gravity [s^2/m].
        effects: the candidate effects, in the order of the columns.
        shapes: (r, e) of each effect along its coordinate, for each actuator that it acts on.
        rows: (e, n) coordinate of each effect: its column of actuator i is shapes[i] * rows[:, i].
    """

    tau: NDArray[np.float64]
    base: NDArray[np.float64]
    rigid: NDArray[np.float64]
    tilts: NDArray[np.float64]
    effects: tuple[ActuatorEffect, ...]
    shapes: tuple[NDArray[np.float64], ...]
    rows: NDArray[np.float64]


def drive_effects(arm: Arm, grid: MotionGrid) -> list[ActuatorEffect]:
    """What every drive has, and what the arm's file says that its drives have (`motion.known_effects`).

    Every actuator has an offset; every coordinate viscous, Coulomb and presliding friction.

    Raises:
        ArmError: the file names a coordinate or a kind that there is not.
    """
    known = arm.identification.known_effects
    if unknown := set(known) - set(distinct_coordinates(arm)):
        raise ArmError(
            f"{arm.source}: motion.known_effects: unknown coordinate {', '.join(sorted(unknown))}; "
            f"known: {', '.join(distinct_coordinates(arm))}"
        )
    effects, travels = [], arm.identification.presliding_travels
    for name, x, v in _coordinates(arm, grid):
        if name.startswith("actuator."):
            effects.append(ActuatorEffect(name, "offset"))
        effects.append(ActuatorEffect(name, "viscous"))
        if v.std() > 0:
            effects += [ActuatorEffect(name, "coulomb", _rounded(w * v.std())) for w in COULOMB_WIDTHS]
            effects += [ActuatorEffect(name, "presliding", _rounded(d * x.std())) for d in travels]
            effects += [effect for which in known.get(name, []) for effect in _named(arm, name, which, x, v)]
    return effects


def named_effects(arm: Arm, q: NDArray[np.float64]) -> list[ActuatorEffect]:
    """Springs and cables that the arm's file names (`motion.known_effects`), over positions q (m, n) of the joints."""
    effects = []
    for name, kinds in arm.identification.known_effects.items():
        x = position_along(arm, name, q)
        effects += [e for kind in kinds if kind != ASYMMETRIC for e in _named(arm, name, kind, x, np.zeros_like(x))]
    return effects


def optional_effects(arm: Arm, grid: MotionGrid) -> list[ActuatorEffect]:
    """What a motion may show beside: what an arm's file can name, friction that grows at low speeds or with load."""
    effects = []
    for name, x, v in _coordinates(arm, grid):
        if v.std() == 0:
            continue
        kinds = ["stribeck", "load coulomb"] if name.startswith("actuator.") else ["stribeck"]
        effects += [ActuatorEffect(name, kind, _rounded(DIRECTION_WIDTH * v.std())) for kind in kinds]
        known = arm.identification.known_effects.get(name, [])
        for which in NAMED_EFFECTS:
            # Beside known torques by position, others say the same between the poses of a motion, and run apart beyond.
            by_position = which != ASYMMETRIC
            if which in known or (by_position and set(known) - {ASYMMETRIC}):
                continue
            if which == "spring" or not by_position or not slides(arm, name):
                effects += _named(arm, name, which, x, v)
    return effects


def _named(
    arm: Arm, coordinate: str, which: str, x: NDArray[np.float64], v: NDArray[np.float64]
) -> list[ActuatorEffect]:
    """What an arm's file calls `which`."""
    where = f"{arm.source}: motion.known_effects.{coordinate}"
    if which not in NAMED_EFFECTS:
        raise ArmError(f'{where}: unknown "{which}"; known: {", ".join(NAMED_EFFECTS)}')
    if which == ASYMMETRIC:
        return [ActuatorEffect(coordinate, "coulomb forward", _rounded(DIRECTION_WIDTH * v.std()))]
    if which == "spring":
        return [spring_over(coordinate, x)]
    effects = [ActuatorEffect(coordinate, kind, NAMED_EFFECTS[which]) for kind in ("cable sine", "cable cosine")]
    if fault := effect_fault(arm, effects[0]):
        raise ArmError(f"{where}: {fault}")
    return effects


def dynamic_columns(
    grid: MotionGrid, tau: NDArray[np.float64], regressor: DynamicRegressor, effects: Sequence[ActuatorEffect]
) -> DynamicColumns:
    """Columns of all parameters and effects.

    Args:
        grid: the motion.
        tau: (rows, n) recorded efforts of the actuators.
        regressor: of the arm, mounted as expected.
        effects: to make columns of.
    """
    arm = grid.arm
    # Efforts are linear in gravity: those at rest under a gravity of one are the derivative.
    lying = [regressor.with_gravity(axis) for axis in ([1.0, 0, 0], [0, 1.0, 0]) if arm.identification.base_may_tilt]
    columns = base_columns([regressor, *lying])
    rigid = _filtered(grid, regressor.regressor(grid.q, grid.v, grid.vd), columns)
    rest = np.zeros_like(grid.q)
    tilts = [_filtered(grid, r.regressor(grid.q, rest, rest), columns) for r in lying]
    on_grid = np.column_stack(list(effect_shapes(regressor, effects, grid.q, grid.v)))
    rows = np.array([arm.effect_coordinates[effect.coordinate] for effect in effects])
    delays = np.array(grid.settings.effort_delay)
    by_delay = {}
    for i, delay in enumerate(delays):
        if delay not in by_delay:
            acting = np.flatnonzero(np.any(rows[:, delays == delay], axis=1))
            by_delay[delay] = np.zeros((len(rigid), len(effects)))
            by_delay[delay][:, acting] = grid.behind_filter(grid.at_rows(on_grid[:, acting], i))
    shapes = tuple(by_delay[delay] for delay in delays)
    return DynamicColumns(
        tau=grid.behind_filter(tau),
        base=columns.base,
        rigid=rigid,
        tilts=np.array(tilts).reshape(-1, *rigid.shape),
        effects=tuple(effects),
        shapes=shapes,
        rows=rows,
    )


class BaseColumns(NamedTuple):
    """Columns of an arm's regressors that the others depend on, see `independent_columns`.

    Attributes:
        independent, base: (b,) and (b, p), as `independent_columns` returns them.
        moves: (n, b) where a column is not 0 for a joint.
    """

    independent: NDArray[np.int_]
    base: NDArray[np.float64]
    moves: NDArray[np.bool_]

    def of_actuator(
        self, Y: NDArray[np.float64], drives: NDArray[np.float64]
    ) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
        """Which of the b columns an actuator has, and these (m, c), from a regressor (m, n, p) of the joints.

        `drives` (n,): by how much each joint moves per unit of the actuator.
        """
        joints = np.flatnonzero(drives)
        own = np.flatnonzero(np.any(self.moves[joints], axis=0))
        return own, np.asarray(sum(drives[j] * Y[:, j, self.independent[own]] for j in joints))


def base_columns(regressors: Sequence[DynamicRegressor]) -> BaseColumns:
    """Finds columns that suffice for one arm under all given gravities, without coupled rotors (`rotor_inertias`)."""
    arm, p = regressors[0].arm, len(regressors[0].values)
    generator = np.random.default_rng(0)
    q, v, vd = generator.normal(0, 2, (3, p // 2, arm.num_joints))
    Y = np.concatenate([regressor.regressor(q, v, vd) for regressor in regressors])
    Y = Y[..., : 10 * len(regressors[0].links) + arm.num_joints]
    independent, base = independent_columns(Y.reshape(-1, Y.shape[2]))
    return BaseColumns(independent, base, np.any(Y[..., independent], axis=0))


def _filtered(grid: MotionGrid, Y: NDArray[np.float64], columns: BaseColumns) -> NDArray[np.float64]:
    """(r, n, b) independent columns of the actuators behind the filter, from a regressor (m, n, p) of the joints."""
    out = np.zeros((len(range(*grid.inner.indices(len(grid.row_times)))), Y.shape[1], len(columns.independent)))
    for i, drives in enumerate(grid.arm.transmission.inverse.matrix.T):
        own, of_actuator = columns.of_actuator(Y, drives)
        out[:, i, own] = grid.behind_filter(grid.at_rows(of_actuator, i))
    return out


def _coordinates(arm: Arm, grid: MotionGrid) -> list[tuple[str, NDArray[np.float64], NDArray[np.float64]]]:
    """(name, x, v) of every coordinate of the drive."""
    rows, a_dot = arm.effect_coordinates, arm.transmission.velocity(grid.v)
    names = distinct_coordinates(arm)
    return [(name, position_along(arm, name, grid.q), a_dot @ rows[name]) for name in names]


def _rounded(x: float) -> float:
    """To three digits: a scale is a choice, not a measurement."""
    return float(f"{x:.3g}")
