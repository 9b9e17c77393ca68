"""Reads recordings from CSV files with a header, and from CSV files without a header that have a known layout.

A file with the columns of messages sensor_msgs/JointState is read like a topic of a ROS bag.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import is_package_arm
from dvrk_drake.models.locked_joints import lock_hint
from dvrk_drake.recordings.csv_files import (
    UNITS,
    CsvFile,
    is_comment,
    is_number,
    parse_finite,
    parse_or_nan,
    read_numbers,
)
from dvrk_drake.recordings.joint_states import MESSAGE_BLOCKS, JointState, collect_joint_states, joint_recording
from dvrk_drake.recordings.reader_options import WPI_JOINTS, FileOptions, check_namespace, instrument_notes, sha256_of
from dvrk_drake.recordings.recording import FileCoordinates, Recording

#: Columns with the same text in each row. `write_recording` and `collect` write them.
_STATEMENTS = ("coordinates", "arm")
#: Columns of messages sensor_msgs/JointState: data collection of the dVRK (header.stamp.sec, position with a list),
#: bagpy (header.stamp.secs, position_0), and `rostopic echo -p` (field.header.stamp in nanoseconds, field.position0).
_MESSAGE_FIELD = re.compile(
    r"(?:field\.)?(?:(?P<block>name|position|velocity|effort)(?:[_.\[]?\d+\]?)?|header\.stamp(?P<stamp>|\.n?secs?|\.nanosec))"
)
_STAMP_PARTS = dict.fromkeys((".sec", ".secs"), "sec") | dict.fromkeys((".nsec", ".nsecs", ".nanosec"), "nanosec")
#: Name of a column with its unit, e.g. "q1 [rad]".
_UNIT = re.compile(r"(?P<name>\S.*?)\s*[\[(](?P<unit>[^\])]*)[\])]")
#: Words for the quantity of a joint in the name of a column, e.g. "elbow_joint position [rad]", and its prefix.
_QUANTITIES = {
    **dict.fromkeys(("position", "pos"), "q"),
    **dict.fromkeys(("velocity", "vel"), "qd"),
    **dict.fromkeys(("effort", "torque", "force"), "tau"),
}
#: Names of the column with the times in a file whose columns have the names of joints.
_TIME_NAMES = ("t", "time", "timestamp")


def read_csv(path: Path, options: FileOptions) -> Recording:
    """Reads a recording from a CSV.

    The default coordinates are those in the column `coordinates` or of the layout, or else "joint". Without times and
    rate, the rows are static poses. The names of the columns may contain units.

    Args:
        path: Path of the file.
        options: Arm (default: 7 joints), coordinates, rate and `skip_invalid`.

    Raises:
        RecordingError: The file has no known layout, a cell is not a finite number, or a rate is given for a file with
            times.
    """
    arm, n = options.arm, options.num_joints
    file, comments = CsvFile(path, options.progress), list[tuple[int, list[str]]]()
    for line, row in file.rows():
        cells = [cell.strip() for cell in row]
        if not is_comment(cells):
            break
        comments.append((line, [cell.strip(" #") for cell in cells]))
    else:
        raise RecordingError(f"{path} is empty; needs a header with {_expected_columns(n)}")
    is_headerless = 2 * sum(map(is_number, cells)) >= len(cells)
    if is_headerless and comments and len(comments[-1][1]) == len(cells) and not any(map(is_number, comments[-1][1])):
        # np.savetxt writes the header as a comment.
        is_headerless, (line, cells) = False, comments[-1]
    where, layout = f"{path}, line {line}", _Layout([])
    if fields := _message_fields(where, cells):
        topic = next((comment[0][7:] for _, comment in comments if comment[0].startswith("Topic: ")), "")
        return _read_messages(file, line, cells, fields, topic, options)
    if is_headerless:
        layout = _layout(path, where, len(cells), options)
        line, cells = line - 1, layout.columns
    header, units = _split_units(cells)
    blocks = _columns_of_blocks(where, _with_numbers(where, header, options), options)
    stated = _stated(file, line, header, arm)
    _check_units(where, header, units, blocks, arm)
    found = read_numbers(
        file,
        [f"{name} (column {i})" for i, name in enumerate(header, 1)] if is_headerless else header,
        blocks,
        after=line,
        skip_invalid=options.skip_invalid,
        header_name="the first row" if is_headerless else "the header",
    )
    used = {header[column] for columns in blocks.values() for column in columns} | {*_STATEMENTS}
    ignored = [name for name in header if name and name not in used]
    notes: tuple[str, ...] = ()
    if is_headerless:
        notes = (f"no header: columns read as {', '.join(f'{name}1..{name}{n}' for name in blocks)}",)
    # `collect` writes files without a column t.
    elif "t" not in blocks and options.rate is None and ignored and not {"pose1", "utime"} <= set(header):
        notes = (f"no column t, read as static poses; ignored columns: {', '.join(ignored)}",)
    return options.recording(
        path,
        {name: block[:, 0] if name == "t" else block for name, block in found.blocks.items()},
        found.rows,
        notes=(*notes, *found.notes, *instrument_notes(stated.get("arm", ""), arm)),
        default_rate=layout.rate,
        default_coordinates=layout.coordinates,
        lines=found.lines,
        sha256=sha256_of(path),
        times_from="column",
        file_coordinates=stated.get("coordinates", ""),
        arm_name=stated.get("arm", ""),
    )


def _stated(file: CsvFile, after: int, header: list[str], arm: Arm | None) -> dict[str, str]:
    """Returns the cells of the first row after a line by the names of their columns.

    Raises:
        RecordingError: The column `arm` names another arm.
    """
    line, cells = next(file.rows(after), (0, []))
    if len(cells) != len(header):
        return {}
    stated = {name: cell.strip() for name, cell in zip(header, cells, strict=True)}
    name = stated.get("arm", "").partition("+")[0]
    if name and arm is not None and name.lower() != arm.name.lower():
        raise RecordingError(f"{file.path}, line {line}: the row is of {name[:30]}, but the selected arm is {arm.name}")
    return stated


def _message_fields(where: str, header: list[str]) -> dict[str, list[int]]:
    """Returns the columns of the fields of messages sensor_msgs/JointState, or an empty dictionary.

    A field is one column with a list, or one column per joint, e.g. `position_0` or `field.position0`.
    """
    fields: dict[str, list[int]] = {}
    for column, name in enumerate(header):
        if match := _MESSAGE_FIELD.fullmatch(name):
            fields.setdefault(match["block"] or _STAMP_PARTS.get(match["stamp"], "stamp"), []).append(column)
    if "position" not in fields:
        return {}
    if "name" not in fields or not {"stamp", "sec"} & fields.keys():
        raise RecordingError(
            f"{where}: these are columns of JointState messages (position, velocity, effort), but the joint names "
            "`name` or the times `header.stamp` are missing. Export all fields of the messages, or read the bag."
        )
    return fields


def _read_messages(
    file: CsvFile, after: int, header: list[str], fields: dict[str, list[int]], topic: str, options: FileOptions
) -> Recording:
    """Reads messages, one per row, after the last line of the header. `topic` is the topic in the file, or ""."""
    path = file.path
    arm = options.required_arm(path)
    if topic:
        check_namespace(path, arm, topic, advice="")

    def numbers(line: int, cells: list[str], field: str) -> list[float]:
        columns = fields.get(field, [])
        return [
            parse_or_nan(text, f"{path}, line {line}: {header[column]}")
            for column in columns
            for text in _elements(cells[column])
        ]

    def messages() -> Iterator[JointState]:
        for line, cells in file.rows(after):
            if len(cells) != len(header):
                raise RecordingError(
                    f"{path}, line {line}: the row has {len(cells)} cells, the header has {len(header)}"
                )
            names = [text for column in fields["name"] for text in _elements(cells[column])]
            stamp = 0
            # An integer number of nanoseconds since 1970 has more digits than a floating-point number.
            for field, factor in (("stamp", 1), ("sec", 1_000_000_000), ("nanosec", 1)):
                for column in fields.get(field, []):
                    text = cells[column].strip()
                    where = f"{path}, line {line}: {header[column]}"
                    stamp += factor * int(text if text.isdecimal() else parse_finite(text, where))
            yield JointState(line, stamp, names, *(numbers(line, cells, name) for name in MESSAGE_BLOCKS))

    topic = topic or "JointState messages"
    states = collect_joint_states(path, topic, messages(), skip_invalid=options.skip_invalid, label="line")
    return joint_recording(path, states, options, sha256_of(path))


def _elements(cell: str) -> list[str]:
    """Returns the elements of a list such as "['yaw', 'pitch']" or "array('d', [1, 2])", or of a single value."""
    text = cell.rpartition("[")[2].partition("]")[0]
    return [element for part in text.split(",") if (element := part.strip(" '\"()"))]


def _split_units(cells: list[str]) -> tuple[list[str], list[str]]:
    """Returns the names and the units of columns such as "q1 [rad]". The unit is "" if it is not stated."""
    matches = [_UNIT.fullmatch(cell) for cell in cells]
    names = [match["name"] if match else cell for match, cell in zip(matches, cells, strict=True)]
    return names, [match["unit"].strip() if match else "" for match in matches]


def _check_units(
    where: str, header: list[str], units: list[str], blocks: dict[str, list[int]], arm: Arm | None
) -> None:
    """Raises RecordingError if the header states a wrong unit. Any joint may be prismatic if `arm` is None."""
    for prefix, columns in blocks.items():
        for joint, column in enumerate(columns):
            revolute, prismatic = UNITS[prefix]
            accepted = {revolute, prismatic} if arm is None else {prismatic if arm.prismatic[joint] else revolute}
            unit = re.sub(r"[\s*·.]+", " ", units[column]).replace("Nm", "N m")
            if unit and unit not in accepted:
                raise RecordingError(
                    f"{where}: the unit of {header[column]} is {units[column][:30]}; allowed: "
                    f"{' or '.join(sorted(accepted))}. Convert the numbers, and correct the header."
                )


class _Layout(NamedTuple):
    """Names of the columns of a file without a header, "" if ignored; rate [Hz] of a motion; coordinates."""

    columns: list[str]
    rate: float | None = None
    coordinates: FileCoordinates | None = None


def _layout(path: Path, where: str, width: int, options: FileOptions) -> _Layout:
    """Returns the layout of a file without a header, from its number of columns."""
    arm, n = options.arm, options.num_joints
    columns = {name: [f"{name}{i}" for i in range(1, n + 1)] for name in ("q", "qd", "tau")}
    if width == 3 * n:
        # Motions of WPI (https://github.com/WPI-AIM/dvrk_dynamics_identification).
        is_wpi = n == WPI_JOINTS and (arm is None or is_package_arm(arm))
        return _Layout([*columns["q"], *columns["qd"], *columns["tau"]], *((200.0, "wpi") if is_wpi else ()))
    # Script `dvrk_ecm_psm_gc_collect.py` of the dVRK (https://github.com/jhu-dvrk/dvrk_python), for three joints. In
    # static poses of WPI (https://github.com/WPI-AIM/dvrk_gravity_comp), a column of the gripper follows the joints.
    has_gripper = n == WPI_JOINTS and width == 2 * n + 2
    if width == 2 * n or has_gripper:
        return _Layout([name for prefix in ("q", "tau") for name in (*columns[prefix], *[""] * has_gripper)])
    message = (
        f"{where}: the first row has {width} cell{'s' * (width != 1)} and no header. Allowed without a header for {n} "
        f"joints: {3 * n} columns (q, qd, tau) or {2 * n} (q, tau)"
    )
    if arm is not None and width % 2 == 0 and width // 2 < n:
        message += f". {lock_hint(arm, width // 2)}"
    if path.name.startswith("StateDataCollection"):
        message += f". Files of the cisst collector need their description {path.with_suffix('.desc').name}"
    raise RecordingError(message)


def _with_numbers(where: str, header: list[str], options: FileOptions) -> list[str]:
    """Returns the header with q1, qd1, tau1, ... and t in place of names of joints and quantities.

    Upper case, spaces, dots and underscores make no difference, and the quantity may be the first word.

    Raises:
        RecordingError: A quantity of a joint is missing, or is in two columns.
    """
    if options.arm is None:
        return header
    numbered: dict[str, str] = {}
    columns: dict[str, dict[str, str]] = {"q": {}, "qd": {}, "tau": {}}
    for joint, label in zip(options.arm.joint_names, options.joint_labels, strict=True):
        name = (options.joints or {}).get(joint, joint)
        for word, prefix in _QUANTITIES.items():
            numbered[_plain(f"{name} {word}")] = numbered[_plain(f"{word} {name}")] = f"{prefix}{label}"
            columns[prefix].setdefault(f"{prefix}{label}", f"{name} {word}")
    found = [numbered.get(_plain(name), name) for name in header]
    if found == header or not columns["q"].keys().isdisjoint(header):
        return header  # other columns of a file with q1, q2, ... are ignored
    found = ["t" if _plain(name) in _TIME_NAMES else name for name in found]
    for column in ("t", *numbered.values()):
        if len(same := [name for name, new in zip(header, found, strict=True) if new == column]) > 1:
            raise RecordingError(f"{where}: columns {' and '.join(same[:2])} are the same quantity; remove one of them")
    for prefix, names in columns.items():
        missing = [name for column, name in names.items() if column not in found]
        if missing and (prefix == "q" or len(missing) < len(names)):
            quantity = missing[0].rpartition(" ")[2]
            raise RecordingError(
                f"{where}: missing column{'s' * (len(missing) > 1)} {', '.join(missing)}; needs the {quantity} of each "
                f"joint of {options.arm.name}; --joints states other names, and --locked joints that are not recorded"
            )
    return found


def _plain(name: str) -> str:
    return re.sub(r"[\W_]+", " ", name).strip().lower()


def _columns_of_blocks(where: str, header: list[str], options: FileOptions) -> dict[str, list[int]]:
    """Returns a mapping from a prefix (q, qd, tau, t) to its columns in the header."""
    if duplicate := next((name for name, count in Counter(header).items() if name and count > 1), ""):
        raise RecordingError(f"{where}: column {duplicate[:30]} occurs twice")
    blocks, arm, num_joints = {}, options.arm, options.num_joints
    for prefix, needed in (("q", True), ("qd", False), ("tau", False)):
        names = [f"{prefix}{label}" for label in options.joint_labels]
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
        if f"{prefix}{num_joints + 1}" in header and not options.joints:
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
