"""Efforts of a wrong sign, told by a model of the arm: it needs less of a motion than friction alone would."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.recordings.recording import Recording

#: Efforts that correlate with the model's by less than this have the other sign: one of unknown sign is near 0.
OPPOSITE = -0.3


def refuse_opposite_efforts(
    recording: Recording, names: tuple[str, ...], tau: NDArray[np.float64], expected: NDArray[np.float64]
) -> None:
    """Compares measured efforts with what a model expects, offsets aside.

    Args:
        recording: for the message.
        names: of the n joints whose actuators they are.
        tau, expected: (r, n) of the actuators, behind one low-pass [N m, N].

    Raises:
        RecordingError: an actuator's efforts go against the model's.
    """
    x, y = tau - np.mean(tau, axis=0), expected - np.mean(expected, axis=0)
    size = np.sqrt(np.sum(x**2, axis=0) * np.sum(y**2, axis=0))
    correlation = np.sum(x * y, axis=0) / np.maximum(size, np.finfo(float).tiny)
    if len(wrong := np.flatnonzero(correlation < OPPOSITE)):
        which = ", ".join(f"{names[j]} ({correlation[j]:.2f})" for j in wrong)
        raise RecordingError(
            f"{recording.source or 'recording'}: efforts go against the model's (correlation): {which}; tau or the "
            "direction of q has the wrong sign there, or it is another arm: efforts are positive towards +q"
        )
