"""Gravity in the frame of a base whose pose a topic of the setup joints states."""

from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.math import RollPitchYaw

pytest.importorskip("cyclonedds", reason="needs cyclonedds")

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.arm import mount_gravity
from dvrk_drake.systems.ros.discovery import topic_gravity
from dvrk_drake.systems.ros.messages import Pose, PoseStamped, Quaternion

TOPIC = "/SUJ/PSM1/local/measured_cp"


def domain(*messages):
    """Returns a substitute domain whose only topic has these messages."""
    return SimpleNamespace(
        name="ROS domain 5",
        subscribe=lambda topic, message_type, **options: SimpleNamespace(
            take=lambda: [(message, 0) for message in messages]
        ),
        wait_until=lambda condition, seconds: condition(),
    )


def message(x, y, z, w):
    return PoseStamped(pose=Pose(orientation=Quaternion(x, y, z, w)))


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.35, 0.0, 0.0), (-1.2, 0.4, 2.0)])
def test_gravity_equals_that_of_the_mounting_angles(angles):
    r = RollPitchYaw(*angles).ToQuaternion()
    gravity = topic_gravity(TOPIC, domain(message(r.x(), r.y(), r.z(), r.w())))
    np.testing.assert_allclose(gravity, mount_gravity(*angles), atol=1e-12)


@pytest.mark.parametrize(
    ("topic", "messages", "text"),
    [
        ("/SUJ/1/pose", [], "No name begins with a digit"),
        (TOPIC, [], f"no message of type PoseStamped on {TOPIC}"),
        (TOPIC, [message(0.0, 0.0, 0.0, 0.0)], "norm of the quaternion is 0; allowed: 1"),
        (TOPIC, [message(0.0, 0.0, np.nan, 1.0)], "norm of the quaternion is nan"),
    ],
)
def test_invalid_topic_or_message_is_refused(topic, messages, text):
    with pytest.raises(DvrkDrakeError, match=text):
        topic_gravity(topic, domain(*messages))
