"""Periodic motion of all joints that starts and ends at rest, and its file."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.errors import ExcitationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.environment import Environment
from dvrk_drake.models.files import atomic_write, refuse_existing
from dvrk_drake.models.ranges import within
from dvrk_drake.models.typed_yaml import load_yaml, typed_content

#: Largest velocity and acceleration at both ends of a motion in a file, as a share of the largest values in the motion.
AT_REST = 1e-6


class JointMotion(NamedTuple):
    """Joint motion at m times.

    Attributes:
        q: Positions (m, n) [rad, m].
        v: Velocities (m, n) [rad/s, m/s].
        vd: Accelerations (m, n) [rad/s^2, m/s^2].
        jerk: Jerks (m, n) [rad/s^3, m/s^3].
    """

    q: NDArray[np.float64]
    v: NDArray[np.float64]
    vd: NDArray[np.float64]
    jerk: NDArray[np.float64]


class FourierBasis(NamedTuple):
    """Functions of time whose weighted sums are the periodic motions with rest at time 0.

    The functions are a constant and the combinations of sin(k w t) and cos(k w t), k = 1 .. h, whose first and second
    derivatives at t = 0 are 0. These combinations are orthonormal in the coefficients of sines and cosines.

    Attributes:
        rates: Angular frequencies (h,) [rad/s].
        sines, cosines: Coefficients (h, 2h - 2) of the functions after the constant.
    """

    rates: NDArray[np.float64]
    sines: NDArray[np.float64]
    cosines: NDArray[np.float64]

    @classmethod
    def of(cls, period: float, harmonics: int) -> FourierBasis:
        """Returns the functions for a period [s] and a number h of harmonics, at least 2."""
        k = np.arange(1, harmonics + 1)
        parts = [np.linalg.svd(row[None])[2][1:].T for row in (k.astype(float), k.astype(float) ** 2)]
        size = harmonics - 1
        zero = np.zeros((harmonics, size))
        return cls(
            np.asarray(2 * np.pi / period * k, dtype=np.float64),
            np.hstack([parts[0], zero]),
            np.hstack([zero, parts[1]]),
        )

    def values(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the functions and their first three derivatives (4, m, 2h - 1) at times t (m,) [s]."""
        out = np.zeros((4, len(t), 1 + self.sines.shape[1]))
        out[0, :, 0] = 1.0
        for k, (s, c) in enumerate(_harmonics(t, self.rates)):
            out[k, :, 1:] = s @ self.sines + c @ self.cosines
        return out


def _harmonics(t: NDArray[np.float64], w: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Returns sines and cosines (m, h) of w t, and their first three derivatives, at times t (m,) for rates w (h,)."""
    phase = t[:, None] * w
    s, c = np.sin(phase), np.cos(phase)
    return [(s, c), (c * w, -s * w), (-s * w**2, -c * w**2), (-c * w**3, s * w**3)]


@dataclass
class PeriodicMotion:
    """Motion of an arm that repeats, with rest at both ends of each period.

    The position of joint j is q_j(t) = center_j + sum_k (sine_jk sin(2 pi k t / period) + cosine_jk (cos(2 pi k t /
    period))), k = 1 .. h.

    Attributes:
        format: Format of the file.
        arm: Name of the arm.
        period: Period [s].
        repetitions: Number of periods.
        environment: Fixed objects that the motion avoids.
        center: Mean positions (n,) [rad, m].
        sine, cosine: Coefficients (n, h) [rad, m].

    Example:
        >>> import dvrk_drake as dvrk
        >>> arm = dvrk.load_arm("mtml")
        >>> design = dvrk.design_excitation(arm, duration=4.0, period=4.0, harmonics=2, starts=1)
        >>> design.motion.save("motion.yaml")
        >>> dvrk.PeriodicMotion.load("motion.yaml", arm) == design.motion
        True
        >>> design.motion.evaluate([0.0, 1.0]).q.shape
        (2, 7)
    """

    format: str = "dvrk_drake motion 1"
    arm: str = ""
    period: float = field(default=10.0, metadata=within(0.1, 600.0, "s"))
    repetitions: int = field(default=1, metadata=within(1, 10_000))
    environment: Environment = field(default_factory=Environment)
    center: list[float] = field(default_factory=list, metadata=within(-100.0, 100.0, "rad or m"))
    sine: list[list[float]] = field(default_factory=list, metadata=within(-100.0, 100.0, "rad or m"))
    cosine: list[list[float]] = field(default_factory=list, metadata=within(-100.0, 100.0, "rad or m"))

    @classmethod
    def of_coefficients(
        cls, arm: Arm, basis: FourierBasis, coefficients: NDArray[np.float64], repetitions: int
    ) -> PeriodicMotion:
        """Returns the motion with the weights `coefficients` (n, 2h - 1) of the functions of a basis."""
        return cls(
            arm=arm.name,
            period=float(2 * np.pi / basis.rates[0]),
            repetitions=repetitions,
            center=coefficients[:, 0].tolist(),
            sine=(coefficients[:, 1:] @ basis.sines.T).tolist(),
            cosine=(coefficients[:, 1:] @ basis.cosines.T).tolist(),
        )

    @classmethod
    def load(cls, path: str | Path, arm: Arm) -> PeriodicMotion:
        """Reads a motion of `arm` from a YAML file.

        Raises:
            ExcitationError: The file is not a motion of this arm, or the motion does not begin at rest.
        """
        content = load_yaml(path, ExcitationError)
        motion = typed_content(cls, content, str(path), ExcitationError, "a motion file", complete=True)
        if motion.arm.lower() != arm.name.lower():
            raise ExcitationError(f'{path}: arm is "{motion.arm}", but the selected arm is {arm.name}')
        n, sizes = arm.num_joints, {len(row) for row in (*motion.sine, *motion.cosine)}
        if {len(motion.center), len(motion.sine), len(motion.cosine)} != {n} or len(sizes) != 1 or 0 in sizes:
            raise ExcitationError(
                f"{path}: center, sine and cosine must have {n} elements each, one per joint of {arm.name}, and each "
                "element of sine and cosine the same number of coefficients"
            )
        start, whole = motion.evaluate([1e-9 * motion.period]), motion.evaluate(np.linspace(0, motion.period, 200))
        for name in ("v", "vd"):
            if np.any(np.abs(getattr(start, name)) > AT_REST * np.abs(getattr(whole, name)).max(initial=1e-12)):
                raise ExcitationError(f"{path}: the motion does not begin at rest")
        return motion

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Writes the motion atomically.

        Raises:
            DvrkDrakeError: The file exists and `overwrite` is False, or the file cannot be written.
        """
        refuse_existing(path, overwrite)
        with atomic_write(path) as stream:
            yaml.safe_dump(asdict(self), stream, sort_keys=False, default_flow_style=None, width=1000)

    @property
    def duration(self) -> float:
        """Duration of all repetitions [s]."""
        return self.period * self.repetitions

    def digest(self) -> str:
        """Returns 16 hexadecimal digits that identify the content of the file."""
        return hashlib.sha256(repr(asdict(self)).encode()).hexdigest()[:16]

    def evaluate(self, t: ArrayLike) -> JointMotion:
        """Returns the motion at times t (m,) [s]. It is at rest before time 0 and after `duration`."""
        time = np.asarray(t, dtype=np.float64)
        moves = ((time > 0) & (time < self.duration))[:, None]
        rate = 2 * np.pi / self.period * np.arange(1.0, len(self.sine[0]) + 1)
        a, b = np.array(self.sine).T, np.array(self.cosine).T
        q, *derivatives = (s @ a + c @ b for s, c in _harmonics(np.clip(time, 0.0, self.duration), rate))
        return JointMotion(np.array(self.center) + q, *(moves * x for x in derivatives))
