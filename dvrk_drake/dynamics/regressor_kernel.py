"""Compiled recursion over the links of an arm, for the dynamic regressor. All arms use the same compiled code.

The recursion processes blocks of `BLOCK` samples. Each quantity of the recursion is a row of `BLOCK` samples, so that
the compiler can vectorise the loops over a block. The compiler vectorises a loop only if it can prove that rows do not
overlap and indices are not negative. Therefore each loop writes to only one array. Sample s of row k is at index
k * BLOCK + s.
"""

from __future__ import annotations

import numba
import numpy as np

from dvrk_drake.dynamics.trigonometry import sin_cos

#: Number of samples per block. It is large enough for vector instructions, and small enough that the rows of a block
#: fit into fast caches.
BLOCK = 64

# "contract" allows fused multiply-add instructions, which round once instead of twice.
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})


@_compiled
def fill_regressor(
    q, v, vd, gravity, parents, pose_terms, hinges, G, c, affects, rotors, out
):  # pragma: no cover - compiled
    """Computes the regressor (m, n, 10 l + r) of an arm with n independent joints, l links and r rotor parameters.

    From base to tip, the recursion computes three quantities of each link in the link frame. These are the spatial
    velocity V, the spatial acceleration A, and the spatial velocity J_j per unit rate of each independent joint j. The
    wrench f about the link's origin is linear in the ten parameters of the link. The torque of joint j due to the link
    is J_j' f. Reference: Featherstone, "Rigid Body Dynamics Algorithms" (2008), 5.3.

    Args:
        q, v, vd: Positions [rad, m], velocities and accelerations (m, n) of the independent joints.
        gravity: Gravity vector (3,) in the base frame [m/s^2].
        parents, pose_terms, hinges, G, c, affects: Attributes of `KinematicTree`.
        rotors: Rows a and b (r, 2, n) of the rotor parameters. Per unit of a parameter, the torque is
            a (b . vd) + b (a . vd).
        out: Array that receives the regressor. Previous values are overwritten.
    """
    num_links, n = G.shape
    motion = np.zeros((3, n * BLOCK))
    joint = np.empty(5 * BLOCK)
    X = np.empty(12 * BLOCK)
    links = np.empty((num_links, 21 * BLOCK))
    J = np.empty((num_links, n, 6 * BLOCK))
    torques = np.empty(10 * BLOCK)
    # Gravity is represented by an upward acceleration of the base. No joint moves the base.
    base, fixed = np.zeros(21 * BLOCK), np.zeros(6 * BLOCK)
    for k in range(3):
        base[(9 + k) * BLOCK : (10 + k) * BLOCK] = -gravity[k]
    for start in range(0, len(q), BLOCK):
        part = out[start : start + BLOCK]
        part.reshape(-1)[:] = 0.0  # Sequential access, which also loads the memory into the cache.
        _to_rows(q[start : start + BLOCK], motion[0])
        _to_rows(v[start : start + BLOCK], motion[1])
        _to_rows(vd[start : start + BLOCK], motion[2])
        for i in range(num_links):
            parent = parents[i]
            _move_joint(G[i], c[i], motion, joint)
            _pose(pose_terms[i], joint, X)
            _move_link(X, hinges[i], joint, links[parent] if parent >= 0 else base, links[i])
            for j in range(n):
                if affects[i, j]:
                    J_P = J[parent, j] if parent >= 0 and affects[parent, j] else fixed
                    _torques(X, hinges[i], G[i, j], J_P, links[i], J[i, j], torques)
                    _from_rows(torques, part[:, j, 10 * i : 10 * i + 10])
        for k in range(len(rotors)):
            _rotor_torques(rotors[k, 0], rotors[k, 1], motion[2], part[:, :, 10 * num_links + k])


@_compiled
def _to_rows(samples, rows):  # pragma: no cover - compiled
    for s in range(len(samples)):
        for k in range(samples.shape[1]):
            rows[k * BLOCK + s] = samples[s, k]


@_compiled
def _from_rows(rows, samples):  # pragma: no cover - compiled
    for s in range(len(samples)):
        for k in range(10):
            samples[s, k] = rows[k * BLOCK + s]


@_compiled
def _move_joint(G, c, motion, joint):  # pragma: no cover - compiled
    """Fills `joint` with the rows x, sin(x), 1 - cos(x), dx/dt and d2x/dt2 of the joint coordinate x = G q + c."""
    joint[:] = 0.0
    for s in range(BLOCK):
        joint[s] = c
    for j in range(len(G)):
        g = G[j]
        if g != 0.0:
            for s in range(BLOCK):
                joint[s] += g * motion[0, j * BLOCK + s]
                joint[3 * BLOCK + s] += g * motion[1, j * BLOCK + s]
                joint[4 * BLOCK + s] += g * motion[2, j * BLOCK + s]
    for s in range(BLOCK):
        sine, cosine = sin_cos(joint[s])
        joint[BLOCK + s], joint[2 * BLOCK + s] = sine, 1.0 - cosine


@_compiled
def _pose(terms, joint, X):  # pragma: no cover - compiled
    """Fills X with 12 rows: the pose X_PC (3, 4) of the link in its parent, row by row."""
    for a in range(3):
        for b in range(4):
            t0, t1, t2, t3 = terms[0, a, b], terms[1, a, b], terms[2, a, b], terms[3, a, b]
            row = (4 * a + b) * BLOCK
            for s in range(BLOCK):
                X[row + s] = t0 + t1 * joint[BLOCK + s] + t2 * joint[2 * BLOCK + s] + t3 * joint[s]


@_compiled
def _to_child(X, s, w0, w1, w2, u0, u1, u2):  # pragma: no cover - compiled
    """Transforms sample s of a spatial velocity (w, u) from P to C: returns R' w and R' (u + w x p)."""
    p0, p1, p2 = X[3 * BLOCK + s], X[7 * BLOCK + s], X[11 * BLOCK + s]
    u0, u1, u2 = u0 + w1 * p2 - w2 * p1, u1 + w2 * p0 - w0 * p2, u2 + w0 * p1 - w1 * p0
    r0, r1, r2 = X[s], X[4 * BLOCK + s], X[8 * BLOCK + s]
    wx, ux = r0 * w0 + r1 * w1 + r2 * w2, r0 * u0 + r1 * u1 + r2 * u2
    r0, r1, r2 = X[BLOCK + s], X[5 * BLOCK + s], X[9 * BLOCK + s]
    wy, uy = r0 * w0 + r1 * w1 + r2 * w2, r0 * u0 + r1 * u1 + r2 * u2
    r0, r1, r2 = X[2 * BLOCK + s], X[6 * BLOCK + s], X[10 * BLOCK + s]
    wz, uz = r0 * w0 + r1 * w1 + r2 * w2, r0 * u0 + r1 * u1 + r2 * u2
    return wx, wy, wz, ux, uy, uz


@_compiled
def _move_link(X, H, joint, P, C):  # pragma: no cover - compiled
    """Fills the rows of link C from the rows of its parent P.

    0..5    spatial velocity V, angular then linear
    6..11   spatial acceleration A = A_P + H d2x/dt2 + V x H dx/dt, where x is the cross product of spatial vectors
    12..14  acceleration of the origin Co minus gravity: linear part of A plus w x v
    15..20  elements xx, yy, zz, xy, xz, yz of [w]^2, where [w] is the cross product matrix of w
    """
    h0, h1, h2, h3, h4, h5 = H
    for s in range(BLOCK):
        xd, xdd = joint[3 * BLOCK + s], joint[4 * BLOCK + s]
        wx, wy, wz, ux, uy, uz = _to_child(
            X, s, P[s], P[BLOCK + s], P[2 * BLOCK + s], P[3 * BLOCK + s], P[4 * BLOCK + s], P[5 * BLOCK + s]
        )
        wx, wy, wz, ux, uy, uz = wx + h0 * xd, wy + h1 * xd, wz + h2 * xd, ux + h3 * xd, uy + h4 * xd, uz + h5 * xd
        dx, dy, dz, ax, ay, az = _to_child(
            X, s, P[6 * BLOCK + s], P[7 * BLOCK + s], P[8 * BLOCK + s], P[9 * BLOCK + s], P[10 * BLOCK + s],
            P[11 * BLOCK + s],
        )  # fmt: skip
        dx += h0 * xdd + (wy * h2 - wz * h1) * xd
        dy += h1 * xdd + (wz * h0 - wx * h2) * xd
        dz += h2 * xdd + (wx * h1 - wy * h0) * xd
        ax += h3 * xdd + (wy * h5 - wz * h4 + uy * h2 - uz * h1) * xd
        ay += h4 * xdd + (wz * h3 - wx * h5 + uz * h0 - ux * h2) * xd
        az += h5 * xdd + (wx * h4 - wy * h3 + ux * h1 - uy * h0) * xd
        C[s], C[BLOCK + s], C[2 * BLOCK + s] = wx, wy, wz
        C[3 * BLOCK + s], C[4 * BLOCK + s], C[5 * BLOCK + s] = ux, uy, uz
        C[6 * BLOCK + s], C[7 * BLOCK + s], C[8 * BLOCK + s] = dx, dy, dz
        C[9 * BLOCK + s], C[10 * BLOCK + s], C[11 * BLOCK + s] = ax, ay, az
        C[12 * BLOCK + s] = ax + wy * uz - wz * uy
        C[13 * BLOCK + s] = ay + wz * ux - wx * uz
        C[14 * BLOCK + s] = az + wx * uy - wy * ux
        C[15 * BLOCK + s] = -wy * wy - wz * wz
        C[16 * BLOCK + s] = -wx * wx - wz * wz
        C[17 * BLOCK + s] = -wx * wx - wy * wy
        C[18 * BLOCK + s], C[19 * BLOCK + s], C[20 * BLOCK + s] = wx * wy, wx * wz, wy * wz


@_compiled
def _torques(X, H, factor, J_P, C, J_C, torques):  # pragma: no cover - compiled
    """Fills J_C and `torques`. The ten rows of `torques` are J_C' f per unit of each parameter of link C.

    J_C' f is the joint torque. J_C is J_P, transformed to C, plus factor * H. `factor` is the element of G for the link
    and the joint. The wrench f has the force m a + [dw] h + [w]^2 h and the moment h x a + I dw + w x I w. Here, m, h
    and I are the mass, first moment and inertia of the link, w and dw are its angular velocity and acceleration, and a
    is the acceleration of its origin minus gravity.
    """
    h0, h1, h2, h3, h4, h5 = H[0] * factor, H[1] * factor, H[2] * factor, H[3] * factor, H[4] * factor, H[5] * factor
    for s in range(BLOCK):
        jx, jy, jz, kx, ky, kz = _to_child(
            X, s, J_P[s], J_P[BLOCK + s], J_P[2 * BLOCK + s], J_P[3 * BLOCK + s], J_P[4 * BLOCK + s], J_P[5 * BLOCK + s]
        )
        jx, jy, jz, kx, ky, kz = jx + h0, jy + h1, jz + h2, kx + h3, ky + h4, kz + h5
        J_C[s], J_C[BLOCK + s], J_C[2 * BLOCK + s] = jx, jy, jz
        J_C[3 * BLOCK + s], J_C[4 * BLOCK + s], J_C[5 * BLOCK + s] = kx, ky, kz
        dx, dy, dz = C[6 * BLOCK + s], C[7 * BLOCK + s], C[8 * BLOCK + s]
        ax, ay, az = C[12 * BLOCK + s], C[13 * BLOCK + s], C[14 * BLOCK + s]
        xx, yy, zz = C[15 * BLOCK + s], C[16 * BLOCK + s], C[17 * BLOCK + s]
        xy, xz, yz = C[18 * BLOCK + s], C[19 * BLOCK + s], C[20 * BLOCK + s]
        torques[s] = kx * ax + ky * ay + kz * az
        torques[BLOCK + s] = kx * xx + ky * (xy + dz) + kz * (xz - dy) + jz * ay - jy * az
        torques[2 * BLOCK + s] = kx * (xy - dz) + ky * yy + kz * (yz + dx) + jx * az - jz * ax
        torques[3 * BLOCK + s] = kx * (xz + dy) + ky * (yz - dx) + kz * zz + jy * ax - jx * ay
        torques[4 * BLOCK + s] = jx * dx + jy * xz - jz * xy
        torques[5 * BLOCK + s] = jy * dy + jz * xy - jx * yz
        torques[6 * BLOCK + s] = jz * dz + jx * yz - jy * xz
        torques[7 * BLOCK + s] = jx * (dy - xz) + jy * (dx + yz) + jz * (xx - yy)
        torques[8 * BLOCK + s] = jx * (dz + xy) + jy * (zz - xx) + jz * (dx - yz)
        torques[9 * BLOCK + s] = jx * (yy - zz) + jy * (dz - xy) + jz * (dy + xz)


@_compiled
def _rotor_torques(a, b, vd, out):  # pragma: no cover - compiled
    """Adds a (b . vd) + b (a . vd) to out (samples, n)."""
    for j in range(len(a)):
        for k in range(len(a)):
            inertia = a[j] * b[k] + b[j] * a[k]
            if inertia != 0.0:
                for s in range(len(out)):
                    out[s, j] += inertia * vd[k * BLOCK + s]
