"""Computes the low-pass filtered regressor columns of a motion, for rigid-body parameters and effects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.observations.motion_grid import MotionGrid
from dvrk_drake.dynamics.actuator_effects import (
    ActuatorEffect,
    distinct_coordinates,
    effect_fault,
    is_prismatic,
    position_along,
    spring_over,
)
from dvrk_drake.dynamics.dynamic_model import ROUNDING_EFFORT, effect_shapes, is_loaded
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.gravity_parameters import independent_columns
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm

#: Widths of the smoothed sign function of Coulomb friction, divided by the standard deviation of the coordinate's
#: velocity [1]. Half of these widths increase the mean cross-validated errors of the public motions `mtm_one` and
#: `psm_one` by 0.07 and 0.26 percentage points, twice these widths change them by less than 0.03.
COULOMB_WIDTHS = (0.03, 0.1, 0.4)
#: Width of the smoothed sign function of all other friction, divided by the same standard deviation [1]. Half or twice
#: the value changes the mean errors of these motions by less than 0.15 percentage points.
DIRECTION_WIDTH = COULOMB_WIDTHS[1]
#: Name of an effect in an arm file -> number of periods of its sine and cosine per revolution.
CABLES = {"cable 1": 1.0, "cable 2": 2.0}
ASYMMETRIC = "asymmetric friction"
#: Name of a friction effect in an arm file -> kind of the effect.
NAMED_FRICTION = {
    ASYMMETRIC: "coulomb forward",
    "load friction": "load coulomb",
    "position friction": "position coulomb",
    "position^2 friction": "position^2 coulomb",
}
NAMED_EFFECTS = ("spring", *CABLES, *NAMED_FRICTION)
#: Kinds of the effects that differ between recordings.
RECORDING_KINDS = ("offset", "viscous", "coulomb")


@dataclass(frozen=True)
class RecordingEffect(ActuatorEffect):
    """Difference of an effect in one recording from the mean over all recordings.

    The model file does not contain these differences. They explain why offsets and friction differ between recordings,
    so that the links and the other effects are those of all recordings.

    Attributes:
        recording: Index of the recording.
    """

    recording: int = 0

    @property
    def dissipative(self) -> bool:
        """False, because the friction in one recording can be less than the mean."""
        return False


@dataclass(frozen=True, eq=False)
class DynamicColumns:
    """Low-pass filtered regressor columns and efforts of one or more motions at r rows.

    For actuator i, tau[:, i] = rigid[:, i] (base phi) + E_i c. Here phi are the rigid-body parameters, and c are the
    coefficients of the effects. The effect columns are E_i = shapes[i] * rows[:, i].

    Attributes:
        tau: Measured efforts (r, n) after low-pass filtering [N m, N], see `MotionGrid.channels`. They are those of the
            actuators if all efforts are measured. Efforts that were not measured, and their columns, are 0.
        base: Matrix (b, p) that maps the p rigid-body parameters to the base parameters. If the arm file allows a base
            tilt, the matrix is valid for every gravity direction. The rigid-body parameters are those of the links,
            then one rotor inertia per actuator.
        rigid: Regressor columns (r, n, b) of the base parameters for the nominal gravity vector.
        tilts: Derivatives (2, r, n, b) of `rigid` with respect to the x and y components of gravity [s^2/m]. The array
            is empty if the arm file does not allow a base tilt.
        effects: Effects, in the order of their columns.
        shapes: Filtered efforts (r, e) of the e effects along their coordinates for coefficients of 1, one array per
            actuator. The arrays differ if the effort delays of the actuators differ.
        rows: Ratios (e, n) of the velocity along the coordinate of each effect to the velocity of each actuator.
    """

    tau: NDArray[np.float64]
    base: NDArray[np.float64]
    rigid: NDArray[np.float64]
    tilts: NDArray[np.float64]
    effects: tuple[ActuatorEffect, ...]
    shapes: tuple[NDArray[np.float64], ...]
    rows: NDArray[np.float64]

    @classmethod
    def of_recordings(cls, columns: Sequence[DynamicColumns]) -> DynamicColumns:
        """Returns the columns of all recordings. A `RecordingEffect` is 0 in the rows of the other recordings.

        Args:
            columns: Columns of each recording, with the same effects.
        """
        if len(columns) == 1:
            return columns[0]
        first = columns[0]
        for k, effect in enumerate(first.effects):
            if isinstance(effect, RecordingEffect):
                for i, own in enumerate(columns):
                    if i != effect.recording:
                        for shape in own.shapes:
                            shape[:, k] = 0.0
        return replace(
            first,
            tau=np.concatenate([own.tau for own in columns]),
            rigid=np.concatenate([own.rigid for own in columns]),
            tilts=np.concatenate([own.tilts for own in columns], axis=1),
            shapes=_of_distinct(lambda *own: np.concatenate(own), *(own.shapes for own in columns)),
        )

    @property
    def acting(self) -> NDArray[np.bool_]:
        """Mask (e,) of the effects that act on a measured effort.

        Friction of a drive whose effort was not measured, or that did not move, does not act on the measured efforts.
        """
        size = [np.max(np.abs(shape), axis=0, initial=0.0) for shape in self.shapes]
        return np.asarray(np.max(np.array(size).T * np.abs(self.rows), axis=1) > ROUNDING_EFFORT)

    def with_effects(self, kept: NDArray[np.bool_]) -> DynamicColumns:
        """Returns the columns of the effects in the mask `kept` (e,)."""
        effects = tuple(effect for effect, keep in zip(self.effects, kept, strict=True) if keep)
        shapes = _of_distinct(lambda shape: shape[:, kept], self.shapes)
        return replace(self, effects=effects, shapes=shapes, rows=self.rows[kept])

    def with_load(
        self,
        grids: Sequence[MotionGrid],
        regressor: DynamicRegressor,
        transmitted: Sequence[NDArray[np.float64]],
        kept: NDArray[np.bool_],
    ) -> DynamicColumns:
        """Returns the columns with other loads of the load-dependent effects.

        Args:
            grids: Resampled motions.
            regressor: Regressor of the arm.
            transmitted: Efforts (m, n) that the drives transmit on each grid [N m, N].
            kept: Mask of the inner rows of the motions that these columns contain.
        """
        loaded = [k for k, effect in enumerate(self.effects) if is_loaded([effect])]
        effects = [self.effects[k] for k in loaded]
        changed = [_effect_columns(grid, regressor, effects, tau) for grid, tau in zip(grids, transmitted, strict=True)]

        def with_changed(shape: NDArray[np.float64], *own: NDArray[np.float64]) -> NDArray[np.float64]:
            shape = shape.copy()
            shape[:, loaded] = np.concatenate(own)[kept]
            return shape

        return replace(self, shapes=_of_distinct(with_changed, self.shapes, *changed))


def _of_distinct(
    function: Callable[..., NDArray[np.float64]], *shapes: Sequence[NDArray[np.float64]]
) -> tuple[NDArray[np.float64], ...]:
    """Applies a function to the shapes of each actuator. Actuators with the same delay keep sharing one array."""
    results: dict[tuple[int, ...], NDArray[np.float64]] = {}
    keys = [tuple(map(id, own)) for own in zip(*shapes, strict=True)]
    for key, own in zip(keys, zip(*shapes, strict=True), strict=True):
        if key not in results:
            results[key] = function(*own)
    return tuple(results[key] for key in keys)


def drive_effects(arm: Arm, grids: Sequence[MotionGrid]) -> list[ActuatorEffect]:
    """Returns the mandatory effects of the model for motions of the arm.

    These are the offset of every actuator and the viscous friction along every coordinate. For every coordinate that
    moves, they also include the Coulomb friction, the presliding friction, and the effects that the arm file lists
    (`motion.known_effects`). If there is more than one motion, the offset and the friction of each actuator may differ
    between the motions (`RecordingEffect`).

    Raises:
        ArmError: The arm file contains an unknown coordinate, an unknown effect, or a cable effect of a prismatic
            coordinate.
    """
    known = arm.identification.known_effects
    if unknown := set(known) - set(distinct_coordinates(arm)):
        raise ArmError(
            f"{arm.source}: motion.known_effects: unknown coordinate {', '.join(sorted(unknown))}. "
            f"Allowed: {', '.join(distinct_coordinates(arm))}."
        )
    effects: list[ActuatorEffect] = []
    travels = arm.identification.presliding_travels
    for name, x, v in _coordinates(arm, grids):
        if name.startswith("actuator."):
            effects.append(ActuatorEffect(name, "offset"))
        effects.append(ActuatorEffect(name, "viscous"))
        if v.std() > 0:
            effects += [ActuatorEffect(name, "coulomb", _rounded(w * v.std())) for w in COULOMB_WIDTHS]
            effects += [ActuatorEffect(name, "presliding", _rounded(d * x.std())) for d in travels]
            effects += [effect for which in known.get(name, []) for effect in _named(arm, name, which, x, v)]
    for name, _, v in _coordinates(arm, grids) if len(grids) > 1 else []:
        scales = {"coulomb": _rounded(DIRECTION_WIDTH * v.std())}
        kinds = RECORDING_KINDS if v.std() > 0 else ("offset",)
        if name.startswith("actuator."):
            effects += [
                RecordingEffect(name, kind, scales.get(kind, 0.0), i) for i in range(len(grids)) for kind in kinds
            ]
    return effects


def named_effects(arm: Arm, q: NDArray[np.float64]) -> list[ActuatorEffect]:
    """Returns the spring and cable effects that the arm file lists in `motion.known_effects`.

    The linear range of a spring contains all positions of its coordinate at the joint positions q (m, n) [rad, m].
    """
    effects = []
    for name, kinds in arm.identification.known_effects.items():
        x = position_along(arm, name, q)
        effects += [
            e for kind in kinds if kind not in NAMED_FRICTION for e in _named(arm, name, kind, x, np.zeros_like(x))
        ]
    return effects


def optional_effects(arm: Arm, grids: Sequence[MotionGrid]) -> list[ActuatorEffect]:
    """Returns the candidate effects: springs, cables, and asymmetric and Stribeck friction.

    Load-dependent friction is not a candidate. On the public motions, it reduced the cross-validated error of one PSM's
    insertion, and doubled the error on other motions of this PSM.
    """
    effects = []
    for name, x, v in _coordinates(arm, grids):
        if v.std() == 0:
            continue
        effects.append(ActuatorEffect(name, "stribeck", _rounded(DIRECTION_WIDTH * v.std())))
        known = arm.identification.known_effects.get(name, [])
        for which in ("spring", *CABLES, ASYMMETRIC):
            # If the arm file lists a spring or a cable for a coordinate, this coordinate gets no candidate springs or
            # cables. An additional spring or cable would be redundant within the range of the motion, and would diverge
            # outside this range.
            by_position = which != ASYMMETRIC
            if which in known or (by_position and set(known) - set(NAMED_FRICTION)):
                continue
            if which == "spring" or not by_position or not is_prismatic(arm, name):
                effects += _named(arm, name, which, x, v)
    return effects


def _named(
    arm: Arm, coordinate: str, which: str, x: NDArray[np.float64], v: NDArray[np.float64]
) -> list[ActuatorEffect]:
    """Returns the effects named `which` in an arm file, scaled for positions x (m,) and velocities v (m,)."""
    where = f"{arm.source}: motion.known_effects.{coordinate}"
    if which not in NAMED_EFFECTS:
        raise ArmError(f'{where}: unknown effect "{which}". Allowed: {", ".join(NAMED_EFFECTS)}.')
    if which in NAMED_FRICTION:
        return [ActuatorEffect(coordinate, NAMED_FRICTION[which], _rounded(DIRECTION_WIDTH * v.std()))]
    if which == "spring":
        return [spring_over(coordinate, x)]
    effects = [ActuatorEffect(coordinate, kind, CABLES[which]) for kind in ("cable sine", "cable cosine")]
    if fault := effect_fault(arm, effects[0]):
        raise ArmError(f"{where}: {fault}")
    return effects


def dynamic_columns(
    grid: MotionGrid, tau: NDArray[np.float64], regressor: DynamicRegressor, effects: Sequence[ActuatorEffect]
) -> DynamicColumns:
    """Computes the regressor columns of all rigid-body parameters and effects for a motion.

    Args:
        grid: Resampled motion.
        tau: Measured efforts (m, n) of the actuators at the rows of the recording [N m, N].
        regressor: Regressor of the arm with its nominal gravity vector.
        effects: Effects of the model.
    """
    arm = grid.arm
    # Efforts are linear in gravity. The derivative of the efforts with respect to a component of gravity is therefore
    # the efforts at rest for a unit gravity vector along this component.
    tilted = [regressor.with_gravity(axis) for axis in ([1.0, 0, 0], [0, 1.0, 0]) if arm.identification.base_may_tilt]
    columns = base_columns([regressor, *tilted])
    rigid = _filtered(grid, regressor, columns)
    tilts = [_filtered(grid.at_rest(), r, columns) for r in tilted]
    nominal = arm.transmission.inverse.pull_back_effort(regressor.torque(grid.q, grid.v, grid.vd, regressor.values))
    return DynamicColumns(
        tau=grid.filter_efforts(tau @ grid.channels.T),
        base=columns.base,
        rigid=rigid,
        tilts=np.array(tilts).reshape(-1, *rigid.shape),
        effects=tuple(effects),
        shapes=_effect_columns(grid, regressor, effects, nominal),
        rows=_effect_rows(grid, effects),
    )


def _is_combined(grid: MotionGrid) -> NDArray[np.bool_]:
    """Returns the mask (n,) of the measured efforts that are combinations of efforts of several actuators."""
    return np.asarray(np.count_nonzero(grid.channels, axis=1) > 1)


def _effect_rows(grid: MotionGrid, effects: Sequence[ActuatorEffect]) -> NDArray[np.float64]:
    """Returns the factors (e, n) of the shapes of effects in the measured efforts.

    The shapes of a combined effort already contain the ratios of its actuators.
    """
    rows = np.array([grid.arm.effect_coordinates[effect.coordinate] for effect in effects]).reshape(
        len(effects), grid.arm.num_joints
    )
    acts = (rows != 0).astype(float) @ (grid.channels != 0).T > 0
    return np.where(_is_combined(grid), acts, rows * np.diag(grid.channels))


def _effect_columns(
    grid: MotionGrid,
    regressor: DynamicRegressor,
    effects: Sequence[ActuatorEffect],
    transmitted: NDArray[np.float64],
) -> tuple[NDArray[np.float64], ...]:
    """Returns the filtered shapes (r, e) of effects, one array per measured effort, see `DynamicColumns.shapes`."""
    delays = np.array(grid.settings.effort_delay)
    by_delay = {delay: np.zeros((len(grid.inner_rows), len(effects))) for delay in dict.fromkeys(delays)}
    # Effects with a state begin anew after a gap.
    of_segments = (effect_shapes(regressor, effects, g.q, g.v, transmitted[own]) for g, own, _ in grid.each_segment())
    for k, (effect, *parts) in enumerate(zip(effects, *of_segments, strict=True)):
        shape = np.concatenate(parts)
        acts = grid.arm.effect_coordinates[effect.coordinate] != 0
        for delay in dict.fromkeys(delays[acts]):
            actuator = int(np.flatnonzero(delays == delay)[0])
            by_delay[delay][:, k] = grid.filter_efforts(grid.at_rows(shape, actuator))
    result = [by_delay[delay] for delay in delays]
    rows = np.array([grid.arm.effect_coordinates[effect.coordinate] for effect in effects])
    for i in np.flatnonzero(_is_combined(grid)) if len(effects) else ():
        weights = grid.channels[i] * rows
        result[i] = sum(by_delay[delay] * weights[:, k] for k, delay in enumerate(delays))
    return tuple(result)


class BaseColumns(NamedTuple):
    """Linearly independent columns of an arm's regressor, see `independent_columns`.

    Attributes:
        independent: Indices (b,) of the independent columns.
        base: Matrix (b, p) that maps the rigid-body parameters to the base parameters.
        moves: Mask (n, b), True where an independent column has nonzero elements for a joint.
    """

    independent: NDArray[np.int_]
    base: NDArray[np.float64]
    moves: NDArray[np.bool_]

    def of_actuator(
        self, Y: NDArray[np.float64], drives: NDArray[np.float64]
    ) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
        """Returns the indices (c,) and values (m, c) of the nonzero columns of one actuator.

        Args:
            Y: Regressor (m, n, p) of the joints.
            drives: Velocity (n,) of each joint per unit velocity of the actuator.
        """
        joints = np.flatnonzero(drives)
        own = np.flatnonzero(np.any(self.moves[joints], axis=0))
        return own, np.asarray(sum(drives[j] * Y[:, j, self.independent[own]] for j in joints))


def base_columns(regressors: Sequence[DynamicRegressor]) -> BaseColumns:
    """Returns the independent columns of the stacked regressors of one arm.

    The regressors differ only in their gravity vectors. Columns of rotor terms that couple two actuators are omitted
    (see `rotor_inertias`).
    """
    arm, p = regressors[0].arm, len(regressors[0].values)
    generator = np.random.default_rng(0)
    q, v, vd = generator.normal(0, 2, (3, p // 2, arm.num_joints))
    Y = np.concatenate([regressor.regressor(q, v, vd) for regressor in regressors])
    Y = Y[..., : 10 * len(regressors[0].links) + arm.num_joints]
    independent, base = independent_columns(Y.reshape(-1, Y.shape[2]))
    return BaseColumns(independent, base, np.any(Y[..., independent], axis=0))


def _filtered(grid: MotionGrid, regressor: DynamicRegressor, columns: BaseColumns) -> NDArray[np.float64]:
    """Returns the filtered independent columns (r, n, b) of the regressor of the actuators."""
    arm, shape = grid.arm, (grid.arm.num_joints, len(regressor.names))
    efforts = np.zeros((len(grid.inner_rows), arm.num_joints, len(columns.independent)))
    start, buffer = 0, np.empty((0, *shape))
    for part, rows in grid.parts():
        if len(part.t) > len(buffer):
            buffer = np.empty((len(part.t), *shape))
        Y = regressor.regressor(part.q, part.v, part.vd, buffer[: len(part.t)])
        for i, drives in enumerate(arm.transmission.inverse.matrix.T):
            own, of_actuator = columns.of_actuator(Y, drives)
            efforts[start : start + len(rows), i, own] = part.filter_rows(part.at_rows(of_actuator, i), rows)
        start += len(rows)
    return efforts if np.array_equal(grid.channels, np.eye(arm.num_joints)) else grid.channels @ efforts


def _coordinates(arm: Arm, grids: Sequence[MotionGrid]) -> list[tuple[str, NDArray[np.float64], NDArray[np.float64]]]:
    """Returns name, position (m,) and velocity (m,) of each coordinate in `distinct_coordinates`."""
    rows = arm.effect_coordinates
    a = np.concatenate([arm.transmission.position(grid.q) for grid in grids])
    a_dot = np.concatenate([arm.transmission.velocity(grid.v) for grid in grids])
    return [(name, a @ rows[name], a_dot @ rows[name]) for name in distinct_coordinates(arm)]


def _rounded(x: float) -> float:
    """Rounds the scale of an effect to three significant digits."""
    return float(f"{x:.3g}")
