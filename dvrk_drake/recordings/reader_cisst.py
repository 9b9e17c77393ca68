"""Reads joint states from a CSV of the cisst collector. A `.desc` file lists the columns of the CSV.

The class `mtsCollectorState` of cisst (https://github.com/jhu-cisst/cisst) writes both files. The description contains
the path of the CSV, the date, the format, the delimiter, three numbers of fields, and one line per column, e.g.
"Data: measured_js.Position[0]:{d}". Each signal of type `prmStateJoint` has a time stamp [s], a flag that marks valid
data, and the names, positions, velocities and efforts of its joints (rad, m, N m, N).
"""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.files import open_input, read_input
from dvrk_drake.recordings.csv_files import CsvFile, read_numbers
from dvrk_drake.recordings.joint_states import JointStates, joint_recording, order_in_time
from dvrk_drake.recordings.reader_options import FileOptions, sha256_of
from dvrk_drake.recordings.recording import Coordinates, Recording

#: Lines of a description before the names of the columns.
_HEAD = 7
_FIELD = re.compile(r"(?:Data|Time): (.*)")
_SIGNAL = re.compile(r"(?P<signal>.*measured_js)\.Position\[0\](:\{.*\})?")
#: Members of prmStateJoint, and the corresponding blocks of a recording.
_MEMBERS = {"q": "Position", "qd": "Velocity", "tau": "Effort"}
#: Signals of a jaw or a gripper. They do not contain the other joints of the arm.
_PARTS = ("jaw/measured_js", "gripper/measured_js")
_ORIGIN = re.compile(r"StateDataCollection-(?P<component>.+)-(?P<table>[^-]+)-\d{4}-")


def is_collector_file(path: Path) -> bool:
    """Returns whether a path is a description file of the collector, or a file with such a description."""
    return path.suffix.lower() == ".desc" or (path.suffix.lower() == ".csv" and path.with_suffix(".desc").is_file())


def read_collector(path: Path, options: FileOptions) -> Recording:
    """Reads the measured joint states of an arm.

    Rows of invalid data, and rows with the time of another one, are omitted and noted. Rows that are not in order are
    sorted and noted.

    Joints are assigned by their names. Actuators, and joints without names, are assigned by their order. The jaw of a
    PSM is read from the signal "jaw/measured_js".

    Args:
        path: Path of the CSV or of its description. Both must be in the same folder.
        options: Arm (required), coordinates, topic, names of the joints, and `skip_invalid`. The default coordinates
            are "actuator" for the signal "measured_js" of a table whose name ends in "Read", and "joint" for all other
            signals. The topic is the name of the signal, e.g. "kin/measured_js". Default: the only signal of the arm.

    Raises:
        RecordingError: A file is missing, the description is damaged, no signal or several signals fit, or the signal
            has other joints.
    """
    arm = options.required_arm(path)
    is_description = path.suffix.lower() == ".desc"
    description = path if is_description else path.with_suffix(".desc")
    data = path.with_suffix(".csv") if is_description else path
    origin, fields = _read_description(description)
    names = [re.sub(r":\{.*\}$", "", field) for field in fields]
    signal, separate = _choose_signal(description, fields, options.topic), f"{arm.separate_joint}/measured_js"
    signals, labels = [signal], _joint_labels(data, _member_columns(names, signal, "Name"))
    if len(_member_columns(names, signal, "Position")) == arm.num_joints - 1 and f"{separate}.Position[0]" in names:
        signals, labels = [signal, separate], [*labels, arm.separate_joint]
    blocks = {
        block: [column for part in signals for column in _member_columns(names, part, member)]
        for block, member in _MEMBERS.items()
    }
    blocks = {block: columns for block, columns in blocks.items() if len(columns) == len(blocks["q"])}
    stated = _stated_coordinates(origin, signal)
    if stated == "actuator" or not (labels and all(map(str.isidentifier, labels))):
        if len(blocks["q"]) != arm.num_joints:
            raise RecordingError(
                f"{description}: {signal} has {len(blocks['q'])} joints, but {arm.name} has {arm.num_joints}: "
                f"{', '.join(arm.joint_names)}"
            )
        labels = list(arm.joint_names)
    for block, member in (("t", f"{signal}.Timestamp"), ("valid", f"{signal}.Valid")):
        if member not in names:
            raise RecordingError(f"{description}: has no column {member}; signals of type prmStateJoint have one")
        blocks[block] = [names.index(member)]
    file = CsvFile(data, options.progress)
    found = read_numbers(file, names, blocks, skip_invalid=options.skip_invalid, header_name=description.name)
    valid = found.blocks["valid"][:, 0] != 0
    notes, usable = list(found.notes), np.flatnonzero(valid)
    if len(usable) < len(valid):
        notes.append(f"{len(valid) - len(usable)} rows of {signal} omitted: marked invalid")
    if not len(usable):
        raise RecordingError(f"{data}: {signal} has no usable row ({'; '.join(notes)})")
    stamps = np.round(1e9 * found.blocks["t"][usable, 0]).astype(np.int64)
    in_time, time_notes = order_in_time(data, f"rows of {signal}", stamps, found.lines[usable], "line", "time")
    rows = usable[in_time]
    q, qd, tau = (found.blocks[block][rows] if block in blocks else None for block in _MEMBERS)
    assert q is not None
    notes += [*time_notes, f"signal {signal} of {origin}, in {options.coordinates or stated} coordinates"]
    states = JointStates(signal, tuple(labels), stamps[in_time], q, qd, tau, found.lines[rows], tuple(notes), "line")
    recording = joint_recording(path, states, options, sha256_of(data))
    coordinates = options.coordinates or stated
    if coordinates == "wpi":
        raise RecordingError(f"{path}: the cisst collector has no wpi coordinates; allowed: joint, actuator")
    return replace(recording, coordinates=coordinates, file_coordinates=coordinates)


def _read_description(path: Path) -> tuple[str, list[str]]:
    """Returns the name of the CSV when it was written, and the names of its columns."""
    try:
        lines = read_input(path, RecordingError).decode().splitlines()
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path} is not a text file: {error.reason}") from error
    fields = [match[1] for line in lines[_HEAD:] if (match := _FIELD.fullmatch(line.strip()))]
    if len(lines) < _HEAD or not lines[4].strip().isdigit() or int(lines[4]) != len(fields):
        raise RecordingError(
            f"{path}: not a complete description of the cisst collector; line 5 must be the number of the lines that "
            f"begin with Data: or Time: ({len(fields)} found)"
        )
    if lines[2].strip() != "CSV" or lines[3].strip() != ",":
        raise RecordingError(f"{path}: the format is {lines[2].strip()}; allowed: CSV with commas")
    return Path(lines[0].strip()).name, fields


def _choose_signal(path: Path, fields: list[str], topic: str | None) -> str:
    signals = [match["signal"] for field in fields if (match := _SIGNAL.fullmatch(field))]
    has = f"Signals with joint states: {', '.join(signals) or 'none'}."
    if topic is not None:
        if topic in signals:
            return topic
        raise RecordingError(f"{path}: has no signal {topic}. {has}")
    fitting = [signal for signal in signals if not signal.endswith(_PARTS)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise RecordingError(f"{path}: several signals fit. {has} Choose one with --topic NAME (topic= in Python).")
    raise RecordingError(f"{path}: has no joint states of an arm. {has} Collect measured_js of the arm.")


def _member_columns(names: list[str], signal: str, member: str) -> list[int]:
    """Returns the columns of a member, e.g. of "measured_js.Position[0]", "measured_js.Position[1]", ..."""
    index = {name: column for column, name in enumerate(names)}
    columns: list[int] = []
    while (name := f"{signal}.{member}[{len(columns)}]") in index:
        columns.append(index[name])
    return columns


def _joint_labels(path: Path, columns: list[int]) -> list[str]:
    """Reads the joint names from the first row of the CSV."""
    with open_input(path, RecordingError) as file:
        line = file.readline().decode(errors="replace")
    cells = next(csv.reader([line]), [])
    return [cells[column].strip() for column in columns if column < len(cells)]


def _stated_coordinates(origin: str, signal: str) -> Coordinates:
    match = _ORIGIN.match(origin)
    is_actuator = match is not None and match["table"].endswith("Read") and signal == "measured_js"
    return "actuator" if is_actuator else "joint"
