"""Options for facts that the file of a recording may not state: arm, topic, coordinates, names and sampling rate."""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import is_package_arm
from dvrk_drake.models.files import open_input
from dvrk_drake.recordings.recording import FileCoordinates, Recording, file_transmission

#: Number of joints of the arms whose public recordings state no joints, and of a file that is read without an arm.
WPI_JOINTS = 7


@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """Options of a reader. For the attributes, see the arguments of `read_recording`."""

    arm: Arm | None = None
    coordinates: FileCoordinates | None = None
    topic: str | None = None
    joints: Mapping[str, str] | None = None
    arrays: Mapping[str, str] | None = None
    rate: float | None = None
    skip_invalid: bool = False
    #: Callback that receives the completed fraction (0 to 1).
    progress: Callable[[float], object] = lambda share: None

    @property
    def num_joints(self) -> int:
        """Number of joints in the file."""
        return self.arm.num_joints if self.arm else WPI_JOINTS

    @property
    def joint_labels(self) -> list[str]:
        """Names of the joints in a file that numbers them: those of `joints`, or else "1", "2", ..."""
        names = self.arm.joint_names if self.arm else [""] * self.num_joints
        return [(self.joints or {}).get(name, str(i)) for i, name in enumerate(names, 1)]

    def joint_order(self, path: Path) -> list[int]:
        """Returns the index (n,) of each joint in a file that numbers its joints.

        Raises:
            RecordingError: A name in `joints` is not the number of a joint.
        """
        numbers = [str(i) for i in range(1, self.num_joints + 1)]
        if wrong := [label for label in self.joint_labels if label not in numbers]:
            raise RecordingError(
                f"{path}: --joints: the file has no joint {wrong[0]}; it has no names, so the joints have the numbers "
                f"1..{len(numbers)}"
            )
        return [numbers.index(label) for label in self.joint_labels]

    def check_joints(self, path: Path) -> None:
        """Checks the mapping `joints` from the arm's name of a joint to its name in the file.

        Raises:
            RecordingError: The arm is missing, it has no joint of a name, or two joints have the same name.
        """
        joints = dict(self.joints or {})
        if not joints:
            return
        arm = self.required_arm(path)
        if unknown := [name for name in joints if name not in arm.joint_names]:
            raise RecordingError(
                f"{path}: --joints {unknown[0]}={joints[unknown[0]]}: {arm.name} has no joint {unknown[0]}; allowed: "
                f"{', '.join(arm.joint_names)}"
            )
        labels = self.joint_labels
        if twice := [label for label in labels if labels.count(label) > 1]:
            raise RecordingError(
                f"{path}: --joints: {twice[0]} is used for two joints of {arm.name}; give one name for each joint"
            )

    def required_arm(self, path: Path) -> Arm:
        """Returns the arm.

        Raises:
            RecordingError: The arm is None.
        """
        if self.arm is None:
            raise RecordingError(
                f"{path}: this format needs the arm whose joint states are read: --arm (arm= in Python)"
            )
        return self.arm

    def recording(
        self,
        path: Path,
        blocks: Mapping[str, NDArray[np.float64]],
        rows: NDArray[np.int_],
        *,
        notes: Iterable[str] = (),
        default_rate: float | None = None,
        default_coordinates: FileCoordinates | None = None,
        **facts: Any,
    ) -> Recording:
        """Returns the recording of a table, with the times and the coordinates of these options.

        Data in "wpi" coordinates are converted to joint coordinates of the arm.

        Args:
            path: Path of the file.
            blocks: Mapping from q, and optionally qd, tau and t, to their numbers (m, n), or (m,) for t.
            rows: Index (m,) of each row among all rows of the file.
            notes: Notes on the rows.
            default_rate: Sampling rate [Hz] of a file without times if these options have no rate. None: the rows are
                static poses, without times.
            default_coordinates: Coordinates if neither the file nor these options state them, or None.
            facts: Other attributes of the recording. `times_from` is the source of t in the file, and
                `file_coordinates` are the coordinates that the file states, or "".

        Raises:
            RecordingError: The rate is not a positive number or is given for a file with times, the file states unknown
                coordinates or other coordinates than these options, or "wpi" is given without an arm.
        """
        t, notes = blocks.get("t"), list(notes)
        if self.rate is not None:
            if not (np.isfinite(self.rate) and self.rate > 0):
                raise RecordingError(f"rate is {self.rate:g} Hz; allowed: a positive number")
            if t is not None:
                raise RecordingError(f"{path}: --rate does not apply, because the file has times")
            facts["times_from"] = "rate"
        if t is None and (rate := self.rate or default_rate):
            t = rows / rate
            notes.append(f"{len(rows)} samples; the file has no times, so t = row / {rate:g} Hz")
        recording = Recording(
            blocks["q"], blocks.get("tau"), blocks.get("qd"), t, source=str(path), notes=tuple(notes), **facts
        )
        stated = recording.file_coordinates
        if stated and stated not in get_args(FileCoordinates):
            allowed = ", ".join(get_args(FileCoordinates))
            raise RecordingError(f'{recording.where(0)}: coordinates is "{stated[:30]}"; allowed: {allowed}')
        if stated and self.coordinates and stated != self.coordinates:
            raise RecordingError(
                f"{recording.where(0)}: the file states {stated} coordinates, not {self.coordinates}. Omit "
                "--coordinates (coordinates= in Python)."
            )
        coordinates = self.coordinates or stated or default_coordinates or ""
        recording = dataclasses.replace(recording, file_coordinates=coordinates)
        if coordinates != "wpi":
            return dataclasses.replace(recording, coordinates=coordinates or "joint")
        return recording.mapped(file_transmission(self.required_arm(path), "wpi").inverse, "joint")


def instrument_notes(recorded: str, arm: Arm | None) -> list[str]:
    """Returns a note if a file is of another instrument than that of the arm.

    Args:
        recorded: `Arm.full_name` of the recorded arm, or its name, if the instrument is not stated.
        arm: Selected arm, if there is one.
    """
    _, _, instrument = recorded.partition("+")
    # The files of the dVRK append a number to the name of an instrument.
    if arm is None or (arm.instrument and instrument.lower().startswith(arm.instrument.lower())) or not instrument:
        return []
    return [f"recorded with the instrument {instrument}, but the selected arm has {arm.instrument or 'none'}"]


def sha256_of(*paths: Path) -> str:
    """Returns the SHA-256 of the contents of files, in this order.

    Raises:
        RecordingError: A file cannot be read.
    """
    digest = hashlib.sha256()
    for path in paths:
        with open_input(path, RecordingError) as file:
            while block := file.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


#: Name of the topic with the measured joint states, in the namespace of an arm.
MEASURED_JS = "measured_js"
_DIGITS = "0123456789"


def fitting_topics(arm: Arm, topic: str | None, names: Iterable[str]) -> list[str]:
    """Returns the JointState topics that fit.

    Args:
        arm: Arm whose joints are read. Used only if `topic` is None.
        topic: Topic or its namespace. None: the topics `/<ARM>/measured_js`, in any namespace, where ARM is the name of
            the arm, optionally followed by a number.
        names: Names of the available topics.
    """
    if topic is not None:
        topic = f"/{topic.strip('/')}"
        return [name for name in (topic, f"{topic}/{MEASURED_JS}") if name in names][:1]
    pattern = re.compile(rf"(/.*)?/{re.escape(arm.name)}[0-9]*/{MEASURED_JS}")
    # A dVRK cart publishes the joints of a setup joint arm on /SUJ/<ARM>/measured_js.
    return [name for name in names if pattern.fullmatch(name) and "/SUJ/" not in name]


def choose_topic(source: str | Path, arm: Arm, topic: str | None, topics: Mapping[str, str]) -> str:
    """Returns the only JointState topic that fits, see `fitting_topics`.

    Args:
        source: Bag or network with the topics, for messages.
        arm: Arm whose joints are read.
        topic: Topic or its namespace. None: the topic of the arm.
        topics: Mapping from the name of each topic to its description, for messages.

    Raises:
        RecordingError: No topic fits, or several topics, or the topic is in the namespace of another arm.
    """
    if topic is not None:
        check_namespace(source, arm, topic)
    fitting = fitting_topics(arm, topic, topics)
    if len(fitting) == 1:
        check_namespace(source, arm, fitting[0].rpartition("/")[0])
        return fitting[0]
    available = f"Topics with JointState messages: {', '.join(topics.values()) or 'none'}."
    if topic is not None:
        raise RecordingError(f"{source}: has no JointState topic {topic}. {available}")
    if fitting:
        raise RecordingError(
            f"{source}: several topics fit {arm.name}: {', '.join(fitting)}. Choose one with --topic TOPIC "
            "(topic= in Python)."
        )
    raise RecordingError(
        f"{source}: has no topic /{arm.name}/{MEASURED_JS}. {available} Check --arm, or choose one "
        "with --topic TOPIC (topic= in Python)."
    )


def check_namespace(
    source: str | Path,
    arm: Arm,
    topic: str,
    advice: str = ", or the namespace of {arm} with --topic (topic= in Python)",
) -> None:
    """Rejects the namespace of another arm of this package, because an MTML and an MTMR have the same joint names.

    The last name of a namespace identifies its arm, e.g. "MTML" in "/lab/MTML", or "PSM" in "/PSM2". An arm with
    another name than those of this package may have any namespace.

    Args:
        source: Bag or network with the topic, for messages.
        arm: Arm whose joints are read.
        topic: Namespace, or its topic measured_js.
        advice: Text of the message after the advice to choose the other arm.

    Raises:
        RecordingError: The namespace has the name of another arm.
    """
    namespace = f"/{topic.strip('/')}".removesuffix(f"/{MEASURED_JS}")
    own, other = arm.name.rstrip(_DIGITS).upper(), namespace.rpartition("/")[2].rstrip(_DIGITS).upper()
    if own != other and is_package_arm(own) and is_package_arm(other):
        raise RecordingError(
            f"{source}: {namespace} is the namespace of the arm {other}, not of {arm.name}. Choose --arm "
            f"{other.lower()}{advice.format(arm=arm.name)}."
        )
