"""The compiled recursion that fills an arm's dynamic regressor, link by link; one compilation serves every arm."""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_regressor(q, v, vd, gravity, parents, pose_terms, hinges, G, c, affects, rotors, out):  # pragma: no cover
    """Fills out (m, n, 10 l + r) for m samples of an arm with n independent joints, l links and r rotor parameters.

    Featherstone, "Rigid Body Dynamics Algorithms" (2008), 5.3, in link coordinates: from base to tip each link gets its
    spatial velocity and acceleration V, A and the velocities J per unit rate of each independent joint. The torque of
    joint j that a link needs is J_j' f, with the wrench f about its origin linear in its ten parameters.

    Args:
        q, v, vd: (m, n) positions, velocities and accelerations of the independent joints.
        gravity: (3,) in the base frame.
        parents, pose_terms, hinges, G, c: as in `KinematicTree`.
        affects: (l, n) which independent joints move which link.
        rotors: (r, 2, n) rows a, b with the torque a (b . vd) + b (a . vd), halved where a is b, per unit of inertia.
        out: written to.
    """
    m, n = q.shape
    l = parents.shape[0]
    V = np.zeros((l, 6))
    A = np.zeros((l, 6))
    J = np.zeros((l, n, 6))
    R = np.zeros((3, 3))
    p = np.zeros(3)
    for s in range(m):
        for i in range(l):
            x, xd, xdd = c[i], 0.0, 0.0
            for j in range(n):
                x += G[i, j] * q[s, j]
                xd += G[i, j] * v[s, j]
                xdd += G[i, j] * vd[s, j]
            sin, versine = math.sin(x), 1.0 - math.cos(x)
            T0, T1, T2, T3 = pose_terms[i, 0], pose_terms[i, 1], pose_terms[i, 2], pose_terms[i, 3]
            for a in range(3):
                for b in range(3):
                    R[a, b] = T0[a, b] + sin * T1[a, b] + versine * T2[a, b]
                p[a] = T0[a, 3] + sin * T1[a, 3] + versine * T2[a, 3] + x * T3[a, 3]
            parent = parents[i]
            H = hinges[i]
            if parent < 0:
                V[i] = 0.0
                A[i, :3] = 0.0
                for a in range(3):
                    A[i, 3 + a] = -(R[0, a] * gravity[0] + R[1, a] * gravity[1] + R[2, a] * gravity[2])
            else:
                _to_child(R, p, V[parent], V[i])
                _to_child(R, p, A[parent], A[i])
            for a in range(6):
                V[i, a] += H[a] * xd
            wx, wy, wz, ux, uy, uz = V[i]
            # A += H xdd + V x H xd (the velocity product of spatial vectors)
            A[i, 0] += H[0] * xdd + (wy * H[2] - wz * H[1]) * xd
            A[i, 1] += H[1] * xdd + (wz * H[0] - wx * H[2]) * xd
            A[i, 2] += H[2] * xdd + (wx * H[1] - wy * H[0]) * xd
            A[i, 3] += H[3] * xdd + (wy * H[5] - wz * H[4] + uy * H[2] - uz * H[1]) * xd
            A[i, 4] += H[4] * xdd + (wz * H[3] - wx * H[5] + uz * H[0] - ux * H[2]) * xd
            A[i, 5] += H[5] * xdd + (wx * H[4] - wy * H[3] + ux * H[1] - uy * H[0]) * xd
            dx, dy, dz = A[i, 0], A[i, 1], A[i, 2]
            # Acceleration of the origin itself, less gravity: the spatial one plus w x v.
            ax = A[i, 3] + wy * uz - wz * uy
            ay = A[i, 4] + wz * ux - wx * uz
            az = A[i, 5] + wx * uy - wy * ux
            xx, yy, zz, xy, xz, yz = wx * wx, wy * wy, wz * wz, wx * wy, wx * wz, wy * wz
            for j in range(n):
                row = out[s, j, 10 * i : 10 * i + 10]
                if not affects[i, j]:
                    row[:] = 0.0
                    continue
                if parent < 0:
                    J[i, j] = 0.0
                else:
                    _to_child(R, p, J[parent, j], J[i, j])
                for a in range(6):
                    J[i, j, a] += H[a] * G[i, j]
                jx, jy, jz, kx, ky, kz = J[i, j]
                row[0] = kx * ax + ky * ay + kz * az
                # Force S h with S = [dw] + [w]^2, moment h x a.
                row[1] = -kx * (yy + zz) + ky * (xy + dz) + kz * (xz - dy) + jz * ay - jy * az
                row[2] = kx * (xy - dz) - ky * (xx + zz) + kz * (yz + dx) + jx * az - jz * ax
                row[3] = kx * (xz + dy) + ky * (yz - dx) - kz * (xx + yy) + jy * ax - jx * ay
                # Moment I dw + w x I w.
                row[4] = jx * dx + jy * xz - jz * xy
                row[5] = -jx * yz + jy * dy + jz * xy
                row[6] = jx * yz - jy * xz + jz * dz
                row[7] = jx * (dy - xz) + jy * (dx + yz) + jz * (xx - yy)
                row[8] = jx * (dz + xy) + jy * (zz - xx) + jz * (dx - yz)
                row[9] = jx * (yy - zz) + jy * (dz - xy) + jz * (dy + xz)
        for k in range(rotors.shape[0]):
            first, second = 0.0, 0.0
            for j in range(n):
                first += rotors[k, 0, j] * vd[s, j]
                second += rotors[k, 1, j] * vd[s, j]
            for j in range(n):
                out[s, j, 10 * l + k] = rotors[k, 0, j] * second + rotors[k, 1, j] * first


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _to_child(R, p, X_P, X_C):  # pragma: no cover
    """A spatial velocity or acceleration of the parent's origin in P -> of the child's, in C: R' w, R' (v + w x p)."""
    w0, w1, w2 = X_P[0], X_P[1], X_P[2]
    u0 = X_P[3] + w1 * p[2] - w2 * p[1]
    u1 = X_P[4] + w2 * p[0] - w0 * p[2]
    u2 = X_P[5] + w0 * p[1] - w1 * p[0]
    for a in range(3):
        X_C[a] = R[0, a] * w0 + R[1, a] * w1 + R[2, a] * w2
        X_C[3 + a] = R[0, a] * u0 + R[1, a] * u1 + R[2, a] * u2
