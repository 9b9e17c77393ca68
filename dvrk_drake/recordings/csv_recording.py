"""Reads recordings from CSV files with a header, and from CSV files without a header that have a known layout.

Layouts without a header, for an arm with n joints:

- 3n columns: positions, velocities and efforts. For n = 7, this is the layout of the motions of WPI
  (https://github.com/WPI-AIM/dvrk_dynamics_identification), which were sampled at 200 Hz.
- 2n columns: positions and efforts of static poses. The script `dvrk_ecm_psm_gc_collect.py` of the dVRK
  (https://github.com/jhu-dvrk/dvrk_python) writes such files for the first three joints of a PSM or of an
  endoscope camera manipulator (ECM).
"""

from __future__ import annotations

import itertools
from collections import Counter
from pathlib import Path

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.locked_joints import lock_hint
from dvrk_drake.recordings.csv_rows import CsvReader, is_number, read_numbers
from dvrk_drake.recordings.file_options import FileOptions
from dvrk_drake.recordings.recording import Recording, column_names

#: Nominal sampling rate of the motions of WPI [Hz].
WPI_RATE = 200.0
_WPI_JOINTS = 7


def read_csv(path: Path, options: FileOptions) -> Recording:
    """Reads a recording from a CSV.

    For 21 columns without a header, the default coordinates are "wpi" and the default rate is `WPI_RATE`. For all other
    files, the default coordinates are "joint". Without times and rate, they contain static poses.

    Args:
        path: Path of the file.
        options: Arm (default: 7 joints), coordinates, rate and `skip_invalid`.

    Raises:
        RecordingError: The file has no known layout, a cell is not a finite number, or a rate is given for a file with
            times.
    """
    arm, n = options.arm, options.num_joints
    with CsvReader(path, options.progress) as reader:
        line, cells = next(iter(reader), (0, []))
        if not cells:
            raise RecordingError(f"{path} is empty; needs a header with {_expected_columns(n)}")
        cells, where = [cell.strip() for cell in cells], f"{path}, line {line}"
        if is_headerless := 2 * sum(map(is_number, cells)) >= len(cells):
            blocks = _layout(path, where, len(cells), arm, n)
            header = [f"{prefix}{i + 1} (column {n * k + i + 1})" for k, prefix in enumerate(blocks) for i in range(n)]
            first = [(line, cells)]
        else:
            header, blocks = cells, _columns_of_blocks(where, cells, arm, n)
            first = list(itertools.islice(reader, 1))
            _check_arm(path, header, first, arm)
        found = read_numbers(
            reader,
            header,
            blocks,
            skip_invalid=options.skip_invalid,
            first=first,
            header_name="the first row" if is_headerless else "the header",
        )
        sha256 = reader.sha256()
    is_wpi = is_headerless and len(header) == 3 * _WPI_JOINTS
    recorded = found.blocks["t"][:, 0] if "t" in blocks else None
    t, time_notes = options.sampled_times(path, recorded, found.rows, WPI_RATE if is_wpi else None)
    if is_headerless:
        time_notes = (f"no header: columns read as {', '.join(f'{name}1..{name}{n}' for name in blocks)}", *time_notes)
    used = {column for columns in blocks.values() for column in columns}
    # `collect` writes files without a column t.
    is_pose_file = {"pose1", "utime"} <= set(header)
    ignored = [name for column, name in enumerate(header) if name and column not in used]
    if t is None and ignored and not is_pose_file:
        time_notes = (f"no column t, read as static poses; ignored columns: {', '.join(ignored)}",)
    recording = Recording(
        found.blocks["q"],
        found.blocks.get("tau"),
        found.blocks.get("qd"),
        t,
        source=str(path),
        lines=found.lines,
        sha256=sha256,
        notes=(*time_notes, *found.notes),
    )
    return options.with_coordinates(recording, "wpi" if is_wpi else "joint")


def _check_arm(path: Path, header: list[str], first: list[tuple[int, list[str]]], arm: Arm | None) -> None:
    """Raises RecordingError if the column `arm` of the first row names another arm. `collect` writes this column."""
    for line, cells in first if arm is not None and "arm" in header else ():
        name = cells[header.index("arm")].strip() if len(cells) == len(header) else ""
        if name and arm is not None and name.lower() != arm.name.lower():
            raise RecordingError(f"{path}, line {line}: the row is of {name[:30]}, but the selected arm is {arm.name}")


def _layout(path: Path, where: str, width: int, arm: Arm | None, n: int) -> dict[str, list[int]]:
    """Returns a mapping from a prefix (q, qd, tau) to its columns in a file without a header."""
    for prefixes in (("q", "qd", "tau"), ("q", "tau")):
        if width == n * len(prefixes):
            return {prefix: list(range(k * n, (k + 1) * n)) for k, prefix in enumerate(prefixes)}
    message = (
        f"{where}: the first row has {width} cell{'s' * (width != 1)} and no header. Allowed without a header for {n} "
        f"joints: {3 * n} columns (q, qd, tau) or {2 * n} (q, tau)"
    )
    if arm is not None and width % 2 == 0 and width // 2 < n:
        message += f". {lock_hint(arm, width // 2)}"
    if path.name.startswith("StateDataCollection"):
        message += f". Files of the cisst collector need their description {path.with_suffix('.desc').name}"
    raise RecordingError(message)


def _columns_of_blocks(where: str, header: list[str], arm: Arm | None, num_joints: int) -> dict[str, list[int]]:
    """Returns a mapping from a prefix (q, qd, tau, t) to its columns in the header."""
    if duplicate := next((name for name, count in Counter(header).items() if name and count > 1), ""):
        raise RecordingError(f"{where}: column {duplicate[:30]} occurs twice")
    blocks = {}
    for prefix, needed in (("q", True), ("qd", False), ("tau", False)):
        names = column_names(prefix, num_joints)
        missing = [name for name in names if name not in header]
        if len(missing) == num_joints and not needed:
            continue
        if missing:
            recorded = num_joints - len(missing)
            hint = lock_hint(arm, recorded) if arm and prefix == "q" and missing == names[recorded:] else ""
            raise RecordingError(
                f"{where}: missing column{'s' * (len(missing) > 1)} {', '.join(missing)}; "
                f"needs {_expected_columns(num_joints)}{_joint_list(arm)}{hint and f'. {hint}'}"
            )
        if f"{prefix}{num_joints + 1}" in header:
            raise RecordingError(
                f"{where}: unexpected column {prefix}{num_joints + 1}; "
                f"the arm has {num_joints} joints{_joint_list(arm)}"
            )
        blocks[prefix] = [header.index(name) for name in names]
    if "t" in header:
        blocks["t"] = [header.index("t")]
    return blocks


def _joint_list(arm: Arm | None) -> str:
    return f"; joints of {arm.name}: {', '.join(arm.joint_names)}" if arm else ""


def _expected_columns(num_joints: int) -> str:
    return f"q1..q{num_joints} and tau1..tau{num_joints} (t and qd1..qd{num_joints} optional)"
