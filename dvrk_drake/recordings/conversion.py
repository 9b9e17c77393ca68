"""Writes recordings of all formats as CSV or MCAP, with notes on properties of the data."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.progress import Progress
from dvrk_drake.recordings.reading import read_recording
from dvrk_drake.recordings.recording import Coordinates, Recording
from dvrk_drake.recordings.writing import write_recording


def convert(
    path: str | Path,
    output: str | Path,
    *,
    arm: Arm | None = None,
    coordinates: Coordinates | None = None,
    topic: str | None = None,
    joints: Mapping[str, str] | None = None,
    arrays: Mapping[str, str] | None = None,
    rate: float | None = None,
    effort_scale: Mapping[str, float] | float | None = None,
    skip_invalid: bool = False,
    progress: Progress | None = None,
) -> Recording:
    """Reads a recording and writes it as a CSV or an MCAP bag for `read_recording`, atomically and with full precision.

    Args:
        path: Path of the recording.
        output: Path of the file to write: .csv, or .mcap for a bag. An existing file is replaced.
        arm: The data are written in the joint coordinates of this arm. If None, they are written in the coordinates of
            the recording. Required to write a bag, and to read a bag or a file of the cisst collector.
        coordinates, topic, joints, arrays, rate, effort_scale, skip_invalid, progress: See `read_recording`.

    Returns:
        Written recording. Its `source`, `lines` and `notes` refer to the original file.

    Raises:
        RecordingError: See `read_recording` and `write_recording`; additionally if `output` is the input recording
            or has another suffix, or the arm cannot reach the poses.
        DvrkDrakeError: The output cannot be written.
    """
    if Path(output).suffix.lower() not in (".csv", ".mcap"):
        raise RecordingError(f"{output}: the name of the output must end in .csv or .mcap (MCAP bag)")
    if os.path.exists(output) and os.path.exists(path) and os.path.samefile(path, output):
        raise RecordingError(f"{output} is the input recording. Choose another output file.")
    recording = read_recording(
        path,
        arm,
        coordinates,
        topic=topic,
        joints=joints,
        arrays=arrays,
        rate=rate,
        effort_scale=effort_scale,
        skip_invalid=skip_invalid,
        progress=progress,
    )
    if arm is not None:
        recording = recording.in_joint_coordinates(arm)
        recording.check_fits(arm)
    write_recording(recording, output, arm)
    assumed: tuple[str, ...] = ()
    if not recording.file_coordinates:
        assumed = ("coordinates were not stated, read as joint coordinates (default)",)
    return dataclasses.replace(recording, notes=(*recording.notes, *assumed, *_properties(recording)))


def _properties(recording: Recording) -> list[str]:
    """Returns notes on times and repeated rows, which affect the next command."""
    notes = []
    if recording.t is None:
        notes.append("without times, read as static poses; for a motion, give its sampling rate with --rate HZ")
        return notes
    steps = np.diff(recording.t)
    interval = f", median interval {1e3 * np.median(steps):.4g} ms" if len(steps) else ""
    notes.append(f"t from {recording.t[0]:g} to {recording.t[-1]:g} s{interval}")
    if np.any(steps <= 0):
        first = recording.where(1 + int(np.argmax(steps <= 0)))
        notes.append(
            f"t does not increase in all rows ({np.sum(steps == 0)} equal, {np.sum(steps < 0)} smaller than the "
            f"previous t; first: {first}). The rows are kept, but identify refuses a motion with such times."
        )
    table = np.hstack([block for block in (recording.q, recording.qd, recording.tau) if block is not None])
    if repeats := int(np.sum(np.all(np.diff(table, axis=0) == 0, axis=1))):
        notes.append(
            f"{repeats} of {len(recording)} rows repeat the previous row (sampled faster than the arm measures); these "
            "rows are kept"
        )
    return notes
