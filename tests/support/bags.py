"""Writes ROS bags with joint states for tests, with the rosbags library."""

from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

#: Kinds of bags.
KINDS = ("ros1", "sqlite3", "mcap")


def joint_states(stamps, names, q=(), qd=(), tau=()):
    """Rows of a topic: (stamp [ns], joint names, position, velocity, effort); an empty block stays empty."""
    empty = np.empty((len(stamps), 0))
    blocks = [np.asarray(block, float) if len(block) else empty for block in (q, qd, tau)]
    return [(int(stamp), list(names), *rows) for stamp, *rows in zip(stamps, *blocks, strict=True)]


def write_bag(folder: Path, kind: str, topics: dict[str, list], **options) -> Path:
    """Writes the rows of each topic; returns the path that a user passes.

    The messages are logged at the times `begin`, `begin` + 1, ... [ns] (default: 0).
    """
    path = folder / {"ros1": "poses.bag", "sqlite3": "poses", "mcap": "poses"}[kind]
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_JAZZY)
    state, header, time = (
        store.types[name]
        for name in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    text = store.types["std_msgs/msg/String"]
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    if kind == "ros1":
        writer = Ros1Writer(path)
    else:
        storage = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Ros2Writer(path, version=9, storage_plugin=storage)
    if "compression" in options:
        writer.set_compression(*options["compression"])
    with writer:
        log = writer.add_connection("/rosout_text", text.__msgtype__, typestore=store)
        writer.write(log, 1, serialize(text(data="a message of another type"), text.__msgtype__))
        for topic, rows in topics.items():
            connection = writer.add_connection(topic, state.__msgtype__, typestore=store)
            for number, (stamp, names, q, qd, tau) in enumerate(rows):
                sequence = {"seq": number} if kind == "ros1" else {}
                stamped = header(stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="", **sequence)
                message = state(header=stamped, name=names, position=q, velocity=qd, effort=tau)
                writer.write(connection, options.get("begin", 0) + number, serialize(message, state.__msgtype__))
    return next(path.glob("*.mcap")) if kind == "mcap" else path
