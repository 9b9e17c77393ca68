"""Reads LeRobot data sets (https://github.com/huggingface/lerobot) of versions 2 and 3.

A data set is a folder. `meta/info.json` contains the names of the joints. The Parquet files in `data` contain one row
per sample, with a list for each quantity: `observation.state` (positions), and often `observation.velocity` and
`observation.effort`. The times of each episode begin at 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.files import open_input, read_json_input
from dvrk_drake.recordings.joint_states import JointState, collect_joint_states, joint_recording
from dvrk_drake.recordings.reader_options import FileOptions, sha256_of
from dvrk_drake.recordings.recording import Recording

_QUANTITIES = ("observation.state", "observation.velocity", "observation.effort")
_TIME, _EPISODE = "timestamp", "episode_index"
#: Time between two episodes in the recording [s], which is a gap of the motion.
_BETWEEN_EPISODES = 1.0


def is_lerobot(path: Path) -> bool:
    """Returns whether a path is the folder of a LeRobot data set."""
    return (path / "meta" / "info.json").is_file()


def read_lerobot(path: Path, options: FileOptions) -> Recording:
    """Reads all episodes of a data set, one after the other. The numbers must be in rad, rad/s and N m.

    Args:
        path: Folder of the data set.
        options: Arm (required), names of its joints in the data set, and `skip_invalid`. Without names in the data set,
            the joints have the order of the arm.

    Raises:
        RecordingError: pyarrow is not installed, a file is damaged, or positions, times or joints are missing.
    """
    try:
        from pyarrow import parquet
    except ImportError as error:
        raise RecordingError(f"{path}: Parquet requires pyarrow. Run: pip install 'dvrk-drake[parquet]'") from error
    info, files = path / "meta" / "info.json", sorted(path.glob("data/**/*.parquet"))
    names = _joint_names(read_json_input(info, RecordingError)) or list(options.required_arm(path).joint_names)
    rows: list[dict[str, Any]] = []
    for number, file in enumerate(files):
        options.progress(number / len(files))
        with open_input(file, RecordingError) as stream:
            try:
                content = parquet.ParquetFile(stream)
                found = [quantity for quantity in _QUANTITIES if quantity in content.schema_arrow.names]
                rows += content.read([_TIME, _EPISODE, *found]).to_pylist()
            except Exception as error:
                # For a damaged file, pyarrow raises errors of several types.
                text = " ".join(str(error).split())
                raise RecordingError(f"{file}: the file is damaged ({text})") from error

    def messages() -> Iterator[JointState]:
        stamp: float = _BETWEEN_EPISODES  # a stamp of 0 marks invalid data
        last: dict[str, Any] = {_EPISODE: None}
        for number, row in enumerate(rows, 1):
            try:
                stamp += row[_TIME] - last[_TIME] if row[_EPISODE] == last[_EPISODE] else _BETWEEN_EPISODES
                blocks = [np.ravel(row.get(quantity) or ()).astype(float) for quantity in _QUANTITIES]
                state = JointState(number, round(1e9 * stamp), names, *blocks)
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                raise RecordingError(f"{path}: row {number} is not a sample with time and episode ({error})") from error
            last = row
            yield state

    states = collect_joint_states(path, _QUANTITIES[0], messages(), skip_invalid=options.skip_invalid, label="row")
    return joint_recording(path, states, options, sha256_of(info, *files))


def _joint_names(info: Any) -> list[str]:
    """Returns the names of the joints in `meta/info.json`, or an empty list.

    They are a list, or a list in another list, or in a dictionary {"motors": [...]}. A name may end in ".pos".
    """
    names: Any = info
    for key in ("features", _QUANTITIES[0], "names"):
        names = names.get(key) if isinstance(names, dict) else None
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    if isinstance(names, list) and names and isinstance(names[0], list):
        names = names[0]
    return [str(name).removesuffix(".pos") for name in names] if isinstance(names, list) else []
