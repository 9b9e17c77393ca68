"""CRTK topics of a simulated arm over DDS."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.ros.crtk_arm_state import REFUSED, ArmValues, CrtkArmState, CrtkCommand
from dvrk_drake.systems.ros.domain import Publisher, RosDomain, Subscription
from dvrk_drake.systems.ros.messages import (
    Bool,
    Empty,
    Header,
    JointState,
    OperatingState,
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    String,
    StringStamped,
    Twist,
    TwistStamped,
    Vector3,
)

#: Time between two checks for subscriptions [s].
_SUBSCRIBERS_PERIOD = 0.1
#: Topics of lines for the operator.
_TEXTS = ("info", "warning", "error")
#: Messages of `state_command` between two ticks, e.g. "enable" and "home". Other topics keep the newest message.
_STATE_COMMANDS = 10


class CrtkArmTopics:
    """Publishers and subscriptions of one arm, with the names, types and quality of service of a dVRK.

    A topic without subscriptions is not published, because encoding needs time. `operating_state` and `state` are
    latched and published when they change. Lines on refused commands are published on `warning`, those on faults on
    `error`, and all other lines on `info`.
    """

    def __init__(self, arm: Arm, namespace: str, domain: RosDomain, tool: ArmFrame) -> None:
        """Creates the topics.

        Args:
            arm: Arm. Its `separate_joint` has topics of its own. An arm without a separate joint has a gripper that is
                measured only, at the angle 0.
            namespace: Namespace of the topics, e.g. "/MTML".
            domain: ROS domain.
            tool: Frame whose poses are published, in the base frame: `Arm.frames.hand`. A dVRK can add the pose of the
                base on its cart, and an instrument can add an offset of the tool tip.
        """
        self._tool = tool
        self._base = f"{namespace.rpartition('/')[2]}_base"
        jaw = arm.separate_joint
        self._main = [i for i, name in enumerate(arm.joint_names) if name != jaw]
        self._jaw = [i for i, name in enumerate(arm.joint_names) if name == jaw]
        self._names = list(arm.joint_names)
        outputs: dict[str, type] = {
            "measured_js": JointState,
            "setpoint_js": JointState,
            "measured_cp": PoseStamped,
            "setpoint_cp": PoseStamped,
            "local/measured_cp": PoseStamped,
            "local/setpoint_cp": PoseStamped,
            "measured_cv": TwistStamped,
            "gravity_compensation/setpoint_js": JointState,
            **({f"{jaw}/{s}_js": JointState for s in ("measured", "setpoint")} if jaw else {}),
            **({} if jaw else {"gripper/measured_js": JointState}),
        }
        self._publishers: dict[str, Publisher[Any]] = {
            name: domain.advertise(f"{namespace}/{name}", message_type) for name, message_type in outputs.items()
        }
        self._operating_state = domain.advertise(f"{namespace}/operating_state", OperatingState, latched=True)
        self._state = domain.advertise(f"{namespace}/state", StringStamped, latched=True)
        self._texts = {name: domain.advertise(f"{namespace}/{name}", StringStamped) for name in _TEXTS}
        if arm.instrument:
            self._tool_type = domain.advertise(f"{namespace}/tool_type", String, latched=True)
            self._tool_type.publish(String(arm.instrument))
        self._published_state: tuple[str, bool, bool] | None = None
        joint_commands = ("servo_jp", "servo_jf", "move_jp")
        inputs: dict[str, type] = {
            "state_command": StringStamped,
            "use_gravity_compensation": Bool,
            **dict.fromkeys(joint_commands, JointState),
            **dict.fromkeys(("servo_cp", "move_cp"), PoseStamped),
            "hold": Empty,
            "free": Empty,
            **({f"{jaw}/{command}": JointState for command in joint_commands} if jaw else {}),
        }
        self._subscriptions: dict[str, Subscription[Any]] = {}
        for name, message_type in inputs.items():
            depth = _STATE_COMMANDS if message_type is StringStamped else 1
            self._subscriptions[name] = domain.subscribe(f"{namespace}/{name}", message_type, depth=depth)
        self._wanted: set[str] = set()
        self._next_check = 0.0

    def take(self) -> list[CrtkCommand]:
        """Returns the commands since the last call, in the order of their publication."""
        received = [
            (published, _command(name, message))
            for name, subscription in self._subscriptions.items()
            for message, published in subscription.take()
        ]
        return [command for _, command in sorted(received, key=lambda item: item[0])]

    def publish_state(self, machine: CrtkArmState) -> None:
        """Publishes the operating state if it has changed.

        Raises:
            DvrkDrakeError: DDS cannot send the message.
        """
        state = (machine.state, machine.is_homed, machine.is_busy)
        if state != self._published_state:
            self._published_state = state
            self._operating_state.publish(OperatingState(Header.now(), *state))
            self._state.publish(StringStamped(Header.now(), machine.state))

    def publish_text(self, line: str) -> None:
        """Publishes a line of `CrtkArmState.take_lines`.

        Raises:
            DvrkDrakeError: DDS cannot send the message.
        """
        name = "error" if line.startswith("FAULT") else "warning" if REFUSED in line else "info"
        self._texts[name].publish(StringStamped(Header.now(), line))

    def publish(self, values: ArmValues, *, is_valid: bool) -> None:
        """Publishes values with the present time of day.

        Args:
            values: Values to publish.
            is_valid: Whether the values are valid. If not, the messages have the time stamp 0 and no values.

        Raises:
            DvrkDrakeError: DDS cannot send a message.
        """
        if (now := time.monotonic()) >= self._next_check:
            self._next_check = now + _SUBSCRIBERS_PERIOD
            self._wanted = {name for name, publisher in self._publishers.items() if publisher.num_subscribers()}
        for name in self._wanted:
            self._publishers[name].publish(self._message(name, values) if is_valid else self._empty(name))

    def _message(self, name: str, values: ArmValues) -> Any:
        header = Header.now("" if name.endswith("js") else self._base)
        if name == "measured_js":
            return self._joint_state(header, self._main, values.q, values.v, values.effort)
        if name == "setpoint_js":
            return self._joint_state(header, self._main, values.setpoint_q, values.setpoint_v, values.setpoint_effort)
        if name.endswith("measured_cp"):
            return _pose(header, self._tool.pose(values.q))
        if name.endswith("setpoint_cp"):
            return _pose(header, self._tool.pose(values.setpoint_q))
        if name == "measured_cv":
            V = (self._tool.jacobian(values.q) @ values.v).tolist()
            return TwistStamped(header, Twist(Vector3(*V[3:]), Vector3(*V[:3])))
        if name == "gravity_compensation/setpoint_js":
            return self._joint_state(header, self._main, effort=values.gravity_effort)
        if name == "gripper/measured_js":
            return JointState(header, ["gripper"], [0.0])
        if name.endswith("/measured_js"):
            return self._joint_state(header, self._jaw, values.q, values.v, values.effort)
        return self._joint_state(header, self._jaw, values.setpoint_q, values.setpoint_v, values.setpoint_effort)

    @staticmethod
    def _empty(name: str) -> Any:
        return {"js": JointState, "cp": PoseStamped, "cv": TwistStamped}[name[-2:]]()

    def _joint_state(
        self,
        header: Header,
        joints: Sequence[int],
        q: NDArray[np.float64] | None = None,
        v: NDArray[np.float64] | None = None,
        effort: NDArray[np.float64] | None = None,
    ) -> JointState:
        numbers = ([] if values is None else values[joints].tolist() for values in (q, v, effort))
        return JointState(header, [self._names[i] for i in joints], *numbers)


def _pose(header: Header, X: RigidTransform) -> PoseStamped:
    rotation = X.rotation().ToQuaternion()
    return PoseStamped(
        header,
        Pose(
            Point(*X.translation().tolist()),
            Quaternion(rotation.x(), rotation.y(), rotation.z(), rotation.w()),
        ),
    )


def _command(name: str, message: Any) -> CrtkCommand:
    """Returns the command in a message of the topic `name`."""
    if isinstance(message, JointState):
        values = message.effort if name.endswith("servo_jf") else message.position
        return CrtkCommand(name, values, message.velocity if name.endswith("servo_jp") else ())
    if isinstance(message, PoseStamped):
        p, r = message.pose.position, message.pose.orientation
        return CrtkCommand(name, (p.x, p.y, p.z, r.x, r.y, r.z, r.w))
    if isinstance(message, StringStamped):
        return CrtkCommand(name, text=message.string)
    return CrtkCommand(name, is_on=isinstance(message, Bool) and message.data)
