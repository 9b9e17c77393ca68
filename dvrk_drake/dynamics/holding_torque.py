"""Static model of an arm: regressor and holding torque tau = Y(q) beta + effects(q), without the feedforward scale.

The holding torque at one pose is a compiled recursion over the links, for control loops.
Links and effects have the same structure. Each has a coordinate x = row q + offset, where q are the positions of the n
independent joints. An effort along this coordinate adds row' effort to the torque of the joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_column, effect_step, joint_row, position_along
from dvrk_drake.dynamics.compiled import compiled, compiled_for, read_only, sin_cos
from dvrk_drake.dynamics.gravity_parameters import GravityParameters, gravity_parameters
from dvrk_drake.dynamics.kinematic_tree import KinematicTree
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS

#: Link with its joint frame Z, see `KinematicTree`. R and p are the pose of Z at x = 0 in the joint frame of the
#: parent, whose index is `parent`. m and h are the mass and the first moment about the origin of Z. The last six fields
#: are intermediate results: x, its sine and cosine, gravity g in Z, and the mass and moment of the link and all links
#: that it carries.
LINK = np.dtype(
    [
        ("parent", np.int64),
        ("prismatic", np.int64),
        ("offset", np.float64),
        ("R", np.float64, (3, 3)),
        ("p", np.float64, (3,)),
        ("m", np.float64),
        ("h", np.float64, (3,)),
        ("x", np.float64),
        ("sine", np.float64),
        ("cosine", np.float64),
        ("g", np.float64, (3,)),
        ("carried_m", np.float64),
        ("carried_h", np.float64, (3,)),
    ]
)
#: Effect at rest with its coefficient; see `ActuatorEffect`.
EFFECT = np.dtype([("code", np.int64), ("scale", np.float64), ("offset", np.float64), ("coefficient", np.float64)])


class HoldingArrays(NamedTuple):
    """Arm with its parameters, for `holding_torque_into`. Threads must not share an object, because it holds results.

    Attributes:
        links: Records `LINK` (1 + l,). The first one is the base, of which only g is used.
        effects: Records `EFFECT` (k,).
        rows: Rows (1 + l + k, n) of the coordinates of links and effects.
    """

    links: NDArray[np.void]
    effects: NDArray[np.void]
    rows: NDArray[np.float64]

    @classmethod
    def of_effects(
        cls, arm: Arm, effects: Sequence[ActuatorEffect], coefficients: NDArray[np.float64]
    ) -> HoldingArrays:
        """Returns effects of an arm without weight. The kinds of the effects must be in `POSITION_KINDS`."""
        zero = np.zeros((1, arm.num_joints))
        offsets = [position_along(arm, effect.coordinate, zero)[0] for effect in effects]
        codes = [EFFECT_KINDS[effect.kind].code for effect in effects]
        scales = [effect.scale for effect in effects]
        records = np.array(list(zip(codes, scales, offsets, coefficients, strict=True)), EFFECT)
        rows = np.array([np.zeros(arm.num_joints), *(joint_row(arm, effect.coordinate) for effect in effects)])
        return cls(np.zeros(1, LINK), records, rows)

    def with_links(
        self, tree: KinematicTree, gravity: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> HoldingArrays:
        """Returns the effects with the links of `tree`.

        Args:
            tree: Links of the arm.
            gravity: Gravity vector (3,) in the base frame [m/s^2].
            weights: Mass and first moment (l, 4) about the origin of each link, in the frame of the link [kg, kg m].
        """
        links = np.zeros(1 + len(tree.links), LINK)
        links["g"][0] = gravity
        moving = links[1:]
        X_ZP = np.array([np.linalg.inv(tree.joint_poses[i]) if i >= 0 else np.eye(4) for i in tree.parents])
        X_ZZ0 = X_ZP @ tree.mounts
        R_CZ, p_CZ = tree.joint_poses[:, :3, :3], tree.joint_poses[:, :3, 3]
        moving["parent"], moving["prismatic"], moving["offset"] = 1 + tree.parents, tree.prismatic, tree.c
        moving["R"], moving["p"] = X_ZZ0[:, :3, :3], X_ZZ0[:, :3, 3]
        moving["m"] = weights[:, 0]
        moving["h"] = np.einsum("ikj,ik->ij", R_CZ, weights[:, 1:] - weights[:, :1] * p_CZ)
        return HoldingArrays(links, self.effects, np.concatenate([self.rows[:1], tree.G, self.rows[1:]]))


#: Type of `HoldingArrays` for compiled functions.
HOLDING = numba.types.NamedTuple(
    (numba.from_dtype(LINK)[::1], numba.from_dtype(EFFECT)[::1], numba.float64[:, ::1]), HoldingArrays
)


@compiled
def _coordinate(row, q, offset):  # pragma: no cover - compiled
    for j in range(len(q)):
        offset += row[j] * q[j]
    return offset


@compiled
def _add_effort(effort, row, torque):  # pragma: no cover - compiled
    for j in range(len(torque)):
        torque[j] += effort * row[j]


@compiled_for(read_only(1), HOLDING, numba.float64[::1])
def holding_torque_into(q, model, torque):  # pragma: no cover - compiled
    """Writes the torque (n,) [N m, N] that holds an arm at pose q (n,) [rad, m] to `torque`.

    The torque of gravity is that of the regressor at rest. It takes less time, because each joint carries the sum of
    the masses and moments of all links beyond it.
    """
    torque[:] = 0.0
    links, effects, rows = model
    num_links = len(links)
    for i in range(1, num_links):
        C = links[i]
        P = links[C.parent]
        C.x = _coordinate(rows[i], q, C.offset)
        C.sine, C.cosine = sin_cos(C.x)
        for k in range(3):
            C.g[k] = C.R[0, k] * P.g[0] + C.R[1, k] * P.g[1] + C.R[2, k] * P.g[2]
        if not C.prismatic:
            C.g[0], C.g[1] = C.cosine * C.g[0] + C.sine * C.g[1], C.cosine * C.g[1] - C.sine * C.g[0]
        C.carried_m = C.m
        for k in range(3):
            C.carried_h[k] = C.h[k]
    for i in range(num_links - 1, 0, -1):
        C = links[i]
        P = links[C.parent]
        m, hx, hy, hz = C.carried_m, C.carried_h[0], C.carried_h[1], C.carried_h[2]
        # The force -m g at the origin of Z and the moment g x h about it hold the link and all links that it carries.
        if C.prismatic:
            _add_effort(-m * C.g[2], rows[i], torque)
            hz += m * C.x
        else:
            _add_effort(C.g[0] * hy - C.g[1] * hx, rows[i], torque)
            hx, hy = C.cosine * hx - C.sine * hy, C.sine * hx + C.cosine * hy
        P.carried_m += m
        for k in range(3):
            P.carried_h[k] += C.R[k, 0] * hx + C.R[k, 1] * hy + C.R[k, 2] * hz + m * C.p[k]
    for k in range(len(effects)):
        effect, row = effects[k], rows[num_links + k]
        x = _coordinate(row, q, effect.offset)
        _, shape = effect_step(effect.code, 0.0, 0.0, x, 0.0, effect.scale)
        _add_effort(effect.coefficient * shape, row, torque)


@compiled_for(read_only(2), HOLDING, numba.float64[:, ::1])
def holding_torques_into(q, model, torque):  # pragma: no cover - compiled
    """Writes the holding torques (m, n) at poses q (m, n) to `torque`, see `holding_torque_into`."""
    for i in range(len(q)):
        holding_torque_into(q[i], model, torque[i])


@dataclass(frozen=True, eq=False)
class StaticModel:
    """Regressor and holding torque of one model structure, which consists of an arm and effects.

    The parameters theta are the b base parameters [kg m, kg], then one coefficient per effect in the unit of its kind.

    Attributes:
        gravity: Base parameters of the gravity torque.
        effects: Effects with kinds in `POSITION_KINDS`, in the order of theta.
    """

    gravity: GravityParameters
    effects: tuple[ActuatorEffect, ...]

    def with_parameters(self, theta: ArrayLike) -> HoldingArrays:
        """Returns the model with parameters theta for `holding_torque_into`."""
        beta, coefficients = np.split(np.asarray(theta, dtype=np.float64), [len(self.gravity.base.names)])
        arm, weights = self.gravity.arm, self.gravity.weights(beta)
        effects = HoldingArrays.of_effects(arm, self.effects, coefficients)
        return effects.with_links(self.gravity.tree, arm.gravity, weights)

    def regressor(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns Y with tau = Y theta: (n, p) for one pose q (n,), (m, n, p) for m poses (m, n)."""
        poses = np.atleast_2d(np.asarray(q, dtype=np.float64))
        of_links = self.gravity.regressor_at(poses)
        columns = [effect_column(self.gravity.arm, effect, poses)[..., None] for effect in self.effects]
        Y = np.concatenate([of_links, *columns], axis=2) if columns else of_links
        return Y if np.ndim(q) == 2 else Y[0]

    def torque(self, q: ArrayLike, theta: ArrayLike) -> NDArray[np.float64]:
        """Returns the holding torque [N m or N]: (n,) for one pose q (n,), (m, n) for m poses (m, n)."""
        poses = np.atleast_2d(np.ascontiguousarray(q, dtype=np.float64))
        tau = np.empty(poses.shape)
        holding_torques_into(poses, self.with_parameters(theta), tau)
        return tau if np.ndim(q) == 2 else tau[0]


@cache
def static_model(arm: Arm, effects: tuple[ActuatorEffect, ...] = ()) -> StaticModel:
    """Returns the static model of an arm with effects."""
    return StaticModel(gravity_parameters(arm), effects)
