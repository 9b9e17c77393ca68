"""Compiled recursion over the links of an arm that computes the regressor of the dynamics.

All arms use the same compiled code. The arrays of a `KinematicTree` describe the arm. A link C has the parent P and the
pose X_PC = (R, p). Its motion and its hinge are expressed in C:

    V_C = X V_P + H dx/dt,    A_C = X A_P + H d2x/dt2 + V_C x H dx/dt,    J_C = X J_P + H G.

Here, x = G q + c is the joint coordinate of the link, V = (w, u) and A = (dw, du) are the spatial velocity and
acceleration of C, and column j of J is the spatial velocity per unit rate of the independent joint j. X transforms
spatial vectors from P to C. A torque is linear in the mass m, the first moment h and the inertia I of each link, about
its origin Co. With the acceleration a = du + w x u of Co, the link needs

    force  m a + dw x h + w x (w x h)    and moment  h x a + I dw + w x I w    about Co.

Gravity is represented by an upward acceleration of the base. Reference: Featherstone, "Rigid Body Dynamics Algorithms"
(2008), 5.3.

The recursion processes blocks of `BLOCK` samples. Each number of the recursion is a row with its values for all samples
of a block, so that the compiler can vectorise the loops over a block. It does so only if each loop writes to one array.
Row k of an array `rows` begins at index k * BLOCK, because the compiler must know the distance of two rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.compiled import (
    add,
    compiled,
    compiled_for,
    cross,
    dot,
    read_only,
    scale,
    sin_cos,
    transposed_times,
)

#: Number of samples per block. It is large enough for vector instructions, and small enough that the rows of a block
#: fit into fast caches.
BLOCK = 64
#: First rows of the vectors in the rows of a link: w, u, dw, du and a.
_W, _U, _DW, _DU, _A = 0, 3, 6, 9, 12
#: Number of rows of a link, of the Jacobian column (w, u) of a joint, and of a pose (three rows of R, then p).
_LINK_ROWS, _JACOBIAN_ROWS, _POSE_ROWS = 15, 6, 12
#: Rows of a joint coordinate: x, sin(x), 1 - cos(x), dx/dt and d2x/dt2.
_X, _SINE, _VERSINE, _RATE, _ACCELERATION, _JOINT_ROWS = 0, 1, 2, 3, 4, 5


class TreeArrays(NamedTuple):
    """Arrays of a `KinematicTree` with l links and n independent joints, for compiled functions.

    Attributes:
        parents: Indices (l,) of the parents, -1 for the base.
        pose_terms: Matrices T0 to T3 (l, 4, 3, 4), each with a rotation part and a translation part [m]. The pose of a
            link is X_PC = T0 + sin(x) T1 + (1 - cos(x)) T2 + x T3.
        hinges: Hinge vectors H (l, 6). They contain the angular velocity of C and the velocity of its origin Co,
            relative to P, per unit of dx/dt, expressed in C.
        G, c: Matrix (l, n) and offsets (l,) of the joint coordinates x = G q + c.
        affects: Mask (l, n), True where an independent joint moves a link.
    """

    parents: NDArray[np.int64]
    pose_terms: NDArray[np.float64]
    hinges: NDArray[np.float64]
    G: NDArray[np.float64]
    c: NDArray[np.float64]
    affects: NDArray[np.bool_]


_number = numba.float64
#: Type of `TreeArrays` for compiled functions.
TREE = numba.types.NamedTuple(
    (
        numba.int64[::1],
        _number[:, :, :, ::1],
        _number[:, ::1],
        _number[:, ::1],
        _number[::1],
        numba.boolean[:, ::1],
    ),
    TreeArrays,
)


@compiled
def _vector(rows, first, s):  # pragma: no cover - compiled
    """Returns the vector of sample s whose elements are the three rows from `first` on."""
    return rows[first * BLOCK + s], rows[(first + 1) * BLOCK + s], rows[(first + 2) * BLOCK + s]


@compiled
def _store(rows, first, s, vector):  # pragma: no cover - compiled
    """Writes a vector to the three rows from `first` on."""
    for k in range(3):
        rows[(first + k) * BLOCK + s] = vector[k]


@compiled
def _pose(X, s):  # pragma: no cover - compiled
    """Returns R and p of sample s."""
    return (_vector(X, 0, s), _vector(X, 3, s), _vector(X, 6, s)), _vector(X, 9, s)


@compiled
def _to_child(R, p, w, u):  # pragma: no cover - compiled
    """Transforms a spatial velocity (w, u) from P to C."""
    return transposed_times(R, w), transposed_times(R, add(u, cross(w, p)))


@compiled
def _hinge(H):  # pragma: no cover - compiled
    """Returns the angular and the linear part of a hinge vector."""
    return (H[0], H[1], H[2]), (H[3], H[4], H[5])


@compiled
def _fill_rows(samples, rows):  # pragma: no cover - compiled
    for s in range(len(samples)):
        for k in range(samples.shape[1]):
            rows[k * BLOCK + s] = samples[s, k]


@compiled
def _fill_samples(rows, samples):  # pragma: no cover - compiled
    for s in range(len(samples)):
        for k in range(samples.shape[1]):
            samples[s, k] = rows[k * BLOCK + s]


@compiled
def _move_joint(G, c, motion, joint):  # pragma: no cover - compiled
    """Fills the rows of the joint coordinate x = G q + c from the rows of q, v and vd."""
    joint[:] = 0.0
    for s in range(BLOCK):
        joint[_X * BLOCK + s] = c
    for j in range(len(G)):
        g = G[j]
        if g != 0.0:
            for s in range(BLOCK):
                joint[_X * BLOCK + s] += g * motion[0, j * BLOCK + s]
            for s in range(BLOCK):
                joint[_RATE * BLOCK + s] += g * motion[1, j * BLOCK + s]
                joint[_ACCELERATION * BLOCK + s] += g * motion[2, j * BLOCK + s]
    for s in range(BLOCK):
        sine, cosine = sin_cos(joint[_X * BLOCK + s])
        joint[_SINE * BLOCK + s], joint[_VERSINE * BLOCK + s] = sine, 1.0 - cosine


@compiled
def _place_link(terms, joint, X):  # pragma: no cover - compiled
    """Fills the rows of the pose X_PC = T0 + sin(x) T1 + (1 - cos(x)) T2 + x T3."""
    for a in range(3):
        for b in range(4):
            t0, t1, t2, t3 = terms[0, a, b], terms[1, a, b], terms[2, a, b], terms[3, a, b]
            row = 3 * a + b if b < 3 else 9 + a
            for s in range(BLOCK):
                X[row * BLOCK + s] = (
                    t0 + t1 * joint[_SINE * BLOCK + s] + t2 * joint[_VERSINE * BLOCK + s] + t3 * joint[_X * BLOCK + s]
                )


@compiled
def _move_link(X, H, joint, P, C):  # pragma: no cover - compiled
    """Fills the rows of link C: V_C, A_C and the acceleration a of its origin, from the rows of its parent P."""
    H_w, H_u = _hinge(H)
    for s in range(BLOCK):
        R, p = _pose(X, s)
        rate, acceleration = joint[_RATE * BLOCK + s], joint[_ACCELERATION * BLOCK + s]
        w, u = _to_child(R, p, _vector(P, _W, s), _vector(P, _U, s))
        w, u = add(w, scale(rate, H_w)), add(u, scale(rate, H_u))
        dw, du = _to_child(R, p, _vector(P, _DW, s), _vector(P, _DU, s))
        dw = add(dw, add(scale(acceleration, H_w), scale(rate, cross(w, H_w))))
        du = add(du, add(scale(acceleration, H_u), scale(rate, add(cross(w, H_u), cross(u, H_w)))))
        _store(C, _W, s, w)
        _store(C, _U, s, u)
        _store(C, _DW, s, dw)
        _store(C, _DU, s, du)
        _store(C, _A, s, add(du, cross(w, u)))


@compiled
def _move_jacobian(X, H, factor, J_P, J_C):  # pragma: no cover - compiled
    """Fills the rows of column j of J_C = X J_P + H G. `factor` is the element of G for the link and the joint j."""
    H_w, H_u = _hinge(H)
    for s in range(BLOCK):
        R, p = _pose(X, s)
        w, u = _to_child(R, p, _vector(J_P, 0, s), _vector(J_P, 3, s))
        _store(J_C, 0, s, add(w, scale(factor, H_w)))
        _store(J_C, 3, s, add(u, scale(factor, H_u)))


@compiled
def _torques(J_C, C, torques):  # pragma: no cover - compiled
    """Fills ten rows: the torque J_u . force + J_w . moment per unit of each parameter m, h and I of link C.

    The factor of h is a x J_w + J_u x dw + w (w . J_u) - J_u (w . w). The torque of I is the sum of its elements times
    those of the matrix J_w dw' + (J_w x w) w'.
    """
    for s in range(BLOCK):
        J_w, J_u = _vector(J_C, 0, s), _vector(J_C, 3, s)
        w, dw, a = _vector(C, _W, s), _vector(C, _DW, s), _vector(C, _A, s)
        of_moment = add(cross(a, J_w), cross(J_u, dw))
        of_moment = add(of_moment, add(scale(dot(w, J_u), w), scale(-dot(w, w), J_u)))
        b = cross(J_w, w)
        torques[s] = dot(J_u, a)
        _store(torques, 1, s, of_moment)
        for k in range(3):
            torques[(4 + k) * BLOCK + s] = J_w[k] * dw[k] + b[k] * w[k]
        torques[7 * BLOCK + s] = J_w[0] * dw[1] + J_w[1] * dw[0] + b[0] * w[1] + b[1] * w[0]
        torques[8 * BLOCK + s] = J_w[0] * dw[2] + J_w[2] * dw[0] + b[0] * w[2] + b[2] * w[0]
        torques[9 * BLOCK + s] = J_w[1] * dw[2] + J_w[2] * dw[1] + b[1] * w[2] + b[2] * w[1]


@compiled
def _rotor_torques(a, b, vd, out):  # pragma: no cover - compiled
    """Adds a (b . vd) + b (a . vd) to out (samples, n)."""
    for j in range(len(a)):
        for k in range(len(a)):
            inertia = a[j] * b[k] + b[j] * a[k]
            if inertia != 0.0:
                for s in range(len(out)):
                    out[s, j] += inertia * vd[k * BLOCK + s]


@compiled_for(*(read_only(2),) * 3, read_only(1), TREE, _number[:, :, ::1], _number[:, :, ::1])
def fill_regressor(q, v, vd, gravity, tree, rotors, out):  # pragma: no cover - compiled
    """Computes the regressor (m, n, 10 l + r) of an arm with n independent joints, l links and r rotor parameters.

    Args:
        q, v, vd: Positions [rad, m], velocities and accelerations (m, n) of the independent joints.
        gravity: Gravity vector (3,) in the base frame [m/s^2].
        tree: Arrays of the arm's `KinematicTree`.
        rotors: Rows a and b (r, 2, n) of the rotor parameters. Per unit of a parameter, the torque is
            a (b . vd) + b (a . vd).
        out: Array that receives the regressor. Previous values are overwritten.
    """
    num_links, n = tree.G.shape
    motion = np.zeros((3, n * BLOCK))
    joint = np.empty(_JOINT_ROWS * BLOCK)
    X = np.empty(_POSE_ROWS * BLOCK)
    links = np.empty((num_links, _LINK_ROWS * BLOCK))
    J = np.empty((num_links, n, _JACOBIAN_ROWS * BLOCK))
    torques = np.empty(10 * BLOCK)
    # No joint moves the base. Gravity is an upward acceleration of the base.
    base, fixed = np.zeros(_LINK_ROWS * BLOCK), np.zeros(_JACOBIAN_ROWS * BLOCK)
    for s in range(BLOCK):
        _store(base, _DU, s, (-gravity[0], -gravity[1], -gravity[2]))
    for start in range(0, len(q), BLOCK):
        part = out[start : start + BLOCK]
        part.reshape(-1)[:] = 0.0  # Sequential access, which also loads the memory into the cache.
        _fill_rows(q[start : start + BLOCK], motion[0])
        _fill_rows(v[start : start + BLOCK], motion[1])
        _fill_rows(vd[start : start + BLOCK], motion[2])
        for i in range(num_links):
            parent, H = tree.parents[i], tree.hinges[i]
            _move_joint(tree.G[i], tree.c[i], motion, joint)
            _place_link(tree.pose_terms[i], joint, X)
            _move_link(X, H, joint, links[parent] if parent >= 0 else base, links[i])
            for j in range(n):
                if tree.affects[i, j]:
                    J_P = J[parent, j] if parent >= 0 and tree.affects[parent, j] else fixed
                    _move_jacobian(X, H, tree.G[i, j], J_P, J[i, j])
                    _torques(J[i, j], links[i], torques)
                    _fill_samples(torques, part[:, j, 10 * i : 10 * i + 10])
        for k in range(len(rotors)):
            _rotor_torques(rotors[k, 0], rotors[k, 1], motion[2], part[:, :, 10 * num_links + k])
