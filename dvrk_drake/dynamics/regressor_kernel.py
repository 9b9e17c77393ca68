"""The compiled recursion that fills an arm's dynamic regressor, link by link; one compilation serves every arm.

Samples are taken in blocks of `BLOCK`, and every number of the recursion is a row of that many samples, so that the
compiler turns each innermost loop into vector instructions. It only does so where it sees that no two rows overlap: a
helper here writes rows of one array, and arrays are flat (row k, sample s at [k * BLOCK + s]).
"""

from __future__ import annotations

import numba
import numpy as np

#: Samples a block: enough to fill vector registers, few enough for the block's rows to stay in the fast caches.
BLOCK = 64

# contract: a product and a sum may be one fused instruction, which rounds once instead of twice.
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})


@_compiled
def fill_regressor(coordinates, vd, gravity, parents, pose_terms, hinges, G, affects, rotors, out):  # pragma: no cover
    """Fills out (m, n, 10 l + r) for m samples of an arm with n independent joints, l links and r rotor parameters.

    Featherstone, "Rigid Body Dynamics Algorithms" (2008), 5.3, in link coordinates: from base to tip each link gets its
    spatial velocity and acceleration V, A and the velocities J per unit rate of each independent joint. The torque of
    joint j that a link needs is J_j' f, with the wrench f about its origin linear in its ten parameters.

    Args:
        coordinates: (5, l, m) of the tree's joints: x, sin(x), 1 - cos(x), dx/dt, d2x/dt2.
        vd: (m, n) accelerations of the independent joints.
        gravity: (3,) in the base frame.
        parents, pose_terms, hinges, G, affects: as in `KinematicTree`.
        rotors: (r, 2, n) rows a, b: the torque is a (b . vd) + b (a . vd) per unit of the parameter.
        out: zeros, or what an earlier call for the same arm left: where a joint moves no link or rotor, 0 stays.
    """
    num_links, n = G.shape
    V, A = np.empty((num_links, 6 * BLOCK)), np.empty((num_links, 6 * BLOCK))
    J = np.empty((num_links, n, 6 * BLOCK))
    at_rest, falling_up = np.zeros(6 * BLOCK), np.zeros(6 * BLOCK)
    for k in range(3):
        for s in range(BLOCK):
            falling_up[(3 + k) * BLOCK + s] = -gravity[k]
    X = np.empty(12 * BLOCK)
    joint = np.zeros(5 * BLOCK)
    motion = np.empty(9 * BLOCK)
    rows = np.empty(10 * BLOCK)
    for start in range(0, len(vd), BLOCK):
        count = min(BLOCK, len(vd) - start)
        for i in range(num_links):
            parent = parents[i]
            _load(coordinates, i, start, count, joint)
            _pose(pose_terms[i], joint, X)
            _to_child(X, V[parent] if parent >= 0 else at_rest, V[i])
            _to_child(X, A[parent] if parent >= 0 else falling_up, A[i])
            _add_velocity(hinges[i], joint, V[i])
            _add_acceleration(hinges[i], joint, V[i], A[i])
            _origin_motion(V[i], A[i], motion)
            for j in range(n):
                if affects[i, j]:
                    _to_child(X, J[parent, j] if parent >= 0 and affects[parent, j] else at_rest, J[i, j])
                    _add_column(hinges[i], G[i, j], J[i, j])
                    _torque_per_parameter(J[i, j], motion, rows)
                    for s in range(count):
                        for k in range(10):
                            out[start + s, j, 10 * i + k] = rows[k * BLOCK + s]
    _fill_rotors(rotors, vd, 10 * num_links, out)


@_compiled
def _load(coordinates, link, start, count, joint):  # pragma: no cover
    for k in range(5):
        for s in range(count):
            joint[k * BLOCK + s] = coordinates[k, link, start + s]


@_compiled
def _pose(terms, joint, X):  # pragma: no cover
    """X_PC rows: rotation and translation of the parent's frame row by row, (3, 4) flattened."""
    for a in range(3):
        for b in range(4):
            t0, t1, t2, t3 = terms[0, a, b], terms[1, a, b], terms[2, a, b], terms[3, a, b]
            row = (4 * a + b) * BLOCK
            for s in range(BLOCK):
                X[row + s] = t0 + t1 * joint[BLOCK + s] + t2 * joint[2 * BLOCK + s] + t3 * joint[s]


@_compiled
def _to_child(X, M_P, M_C):  # pragma: no cover
    """A spatial velocity or acceleration of the parent's origin in P -> of the child's, in C: R' w, R' (v + w x p)."""
    for s in range(BLOCK):
        w0, w1, w2 = M_P[s], M_P[BLOCK + s], M_P[2 * BLOCK + s]
        p0, p1, p2 = X[3 * BLOCK + s], X[7 * BLOCK + s], X[11 * BLOCK + s]
        u0 = M_P[3 * BLOCK + s] + w1 * p2 - w2 * p1
        u1 = M_P[4 * BLOCK + s] + w2 * p0 - w0 * p2
        u2 = M_P[5 * BLOCK + s] + w0 * p1 - w1 * p0
        for a in range(3):
            r0, r1, r2 = X[a * BLOCK + s], X[(4 + a) * BLOCK + s], X[(8 + a) * BLOCK + s]
            M_C[a * BLOCK + s] = r0 * w0 + r1 * w1 + r2 * w2
            M_C[(3 + a) * BLOCK + s] = r0 * u0 + r1 * u1 + r2 * u2


@_compiled
def _add_velocity(H, joint, V):  # pragma: no cover
    for a in range(6):
        h = H[a]
        for s in range(BLOCK):
            V[a * BLOCK + s] += h * joint[3 * BLOCK + s]


@_compiled
def _add_column(H, factor, J):  # pragma: no cover
    for a in range(6):
        h = H[a] * factor
        for s in range(BLOCK):
            J[a * BLOCK + s] += h


@_compiled
def _add_acceleration(H, joint, V, A):  # pragma: no cover
    """A += H d2x/dt2 + V x H dx/dt, the cross product of spatial velocities."""
    h0, h1, h2, h3, h4, h5 = H
    for s in range(BLOCK):
        xd, xdd = joint[3 * BLOCK + s], joint[4 * BLOCK + s]
        wx, wy, wz = V[s], V[BLOCK + s], V[2 * BLOCK + s]
        ux, uy, uz = V[3 * BLOCK + s], V[4 * BLOCK + s], V[5 * BLOCK + s]
        A[s] += h0 * xdd + (wy * h2 - wz * h1) * xd
        A[BLOCK + s] += h1 * xdd + (wz * h0 - wx * h2) * xd
        A[2 * BLOCK + s] += h2 * xdd + (wx * h1 - wy * h0) * xd
        A[3 * BLOCK + s] += h3 * xdd + (wy * h5 - wz * h4 + uy * h2 - uz * h1) * xd
        A[4 * BLOCK + s] += h4 * xdd + (wz * h3 - wx * h5 + uz * h0 - ux * h2) * xd
        A[5 * BLOCK + s] += h5 * xdd + (wx * h4 - wy * h3 + ux * h1 - uy * h0) * xd


@_compiled
def _origin_motion(V, A, motion):  # pragma: no cover
    """Angular velocity and acceleration, and that of the origin less gravity: the spatial one plus w x v."""
    for s in range(BLOCK):
        wx, wy, wz = V[s], V[BLOCK + s], V[2 * BLOCK + s]
        ux, uy, uz = V[3 * BLOCK + s], V[4 * BLOCK + s], V[5 * BLOCK + s]
        motion[s], motion[BLOCK + s], motion[2 * BLOCK + s] = wx, wy, wz
        motion[3 * BLOCK + s], motion[4 * BLOCK + s] = A[s], A[BLOCK + s]
        motion[5 * BLOCK + s] = A[2 * BLOCK + s]
        motion[6 * BLOCK + s] = A[3 * BLOCK + s] + wy * uz - wz * uy
        motion[7 * BLOCK + s] = A[4 * BLOCK + s] + wz * ux - wx * uz
        motion[8 * BLOCK + s] = A[5 * BLOCK + s] + wx * uy - wy * ux


@_compiled
def _torque_per_parameter(J, motion, rows):  # pragma: no cover
    """J' f for each of the ten parameters: force m a + [dw] h + [w]^2 h, moment h x a + I dw + w x I w."""
    for s in range(BLOCK):
        jx, jy, jz = J[s], J[BLOCK + s], J[2 * BLOCK + s]
        kx, ky, kz = J[3 * BLOCK + s], J[4 * BLOCK + s], J[5 * BLOCK + s]
        wx, wy, wz = motion[s], motion[BLOCK + s], motion[2 * BLOCK + s]
        dx, dy, dz = motion[3 * BLOCK + s], motion[4 * BLOCK + s], motion[5 * BLOCK + s]
        ax, ay, az = motion[6 * BLOCK + s], motion[7 * BLOCK + s], motion[8 * BLOCK + s]
        xx, yy, zz, xy, xz, yz = wx * wx, wy * wy, wz * wz, wx * wy, wx * wz, wy * wz
        rows[s] = kx * ax + ky * ay + kz * az
        rows[BLOCK + s] = -kx * (yy + zz) + ky * (xy + dz) + kz * (xz - dy) + jz * ay - jy * az
        rows[2 * BLOCK + s] = kx * (xy - dz) - ky * (xx + zz) + kz * (yz + dx) + jx * az - jz * ax
        rows[3 * BLOCK + s] = kx * (xz + dy) + ky * (yz - dx) - kz * (xx + yy) + jy * ax - jx * ay
        rows[4 * BLOCK + s] = jx * dx + jy * xz - jz * xy
        rows[5 * BLOCK + s] = jy * dy + jz * xy - jx * yz
        rows[6 * BLOCK + s] = jz * dz + jx * yz - jy * xz
        rows[7 * BLOCK + s] = jx * (dy - xz) + jy * (dx + yz) + jz * (xx - yy)
        rows[8 * BLOCK + s] = jx * (dz + xy) + jy * (zz - xx) + jz * (dx - yz)
        rows[9 * BLOCK + s] = jx * (yy - zz) + jy * (dz - xy) + jz * (dy + xz)


@_compiled
def _fill_rotors(rotors, vd, first_column, out):  # pragma: no cover
    m, n = vd.shape
    a_vd, b_vd = np.empty(m), np.empty(m)
    for k in range(len(rotors)):
        a, b = rotors[k]
        a_vd[:] = 0.0
        b_vd[:] = 0.0
        for j in range(n):
            if a[j] != 0.0 or b[j] != 0.0:
                for s in range(m):
                    a_vd[s] += a[j] * vd[s, j]
                    b_vd[s] += b[j] * vd[s, j]
        for j in range(n):
            if a[j] != 0.0 or b[j] != 0.0:
                for s in range(m):
                    out[s, j, first_column + k] = a[j] * b_vd[s] + b[j] * a_vd[s]
