"""The simulated arm that gains are tuned on: what both tuners agree on, and one closed loop for all trials."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.models.effects_schema import ArmEffects, DelayEffect, per_actuator
from dvrk_drake.systems.arm_station import ArmStation, arm_plant_config
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

#: A joint is tried by steps of this size [rad, m].
STEP_REVOLUTE, STEP_PRISMATIC = 0.05, 0.005


def step_size(arm: Arm) -> NDArray[np.float64]:
    """(n,) of each joint [rad, m]."""
    return arm.per_joint(STEP_REVOLUTE, STEP_PRISMATIC)


def band(arm: Arm) -> NDArray[np.float64]:
    """(n,) a joint has settled if it stays this near [rad, m]: 2 % of the step, or a count if that is more."""
    return np.maximum(0.02 * step_size(arm), arm.encoder_counts())


def effort_limits(arm: Arm) -> NDArray[np.float64]:
    """(n,) the largest effort that a joint can have while the others have none: the arm's, or its motors'."""
    motors = per_actuator(arm.effects.saturation, arm.joint_names, np.inf)
    # tau_joint = J' tau_actuator: one joint's effort needs these actuator efforts.
    share = np.abs(np.linalg.inv(arm.transmission.matrix).T)
    with np.errstate(divide="ignore"):
        return np.minimum(arm.effort_limits, np.min(motors[:, None] / share, axis=0))


def known_model(arm: Arm) -> IdentifiedModel:
    """What an identification leaves a controller with: the SDF's links, and springs and cables of the arm's effects."""
    return IdentifiedModel.from_arm(arm, [*arm.effects.cables, *arm.effects.springs])


#: Poses that tuning looks at need this share of each motor's largest effort to be held, at most: with nothing left to
#: move the joint no gains help. (An MTM's wrist spring alone asks for more than its motor has in some of the box.)
HOLDING_SHARE = 0.5


@cache
def tuning_poses(arm: Arm, count: int, seed: int) -> NDArray[np.float64]:
    """(count, n) poses all over the joint box, a tenth of each range from the stops, that the motors hold easily.

    Raises:
        ArmError: hardly any pose is.
    """
    candidates = arm.sample_poses(40 * count, np.random.default_rng(seed), margin=0.1)
    efforts = known_model(arm).holding_torque(candidates) @ np.linalg.inv(arm.transmission.matrix)
    motors = per_actuator(arm.effects.saturation, arm.joint_names, np.inf)
    light = candidates[np.all(np.abs(efforts) <= HOLDING_SHARE * motors, axis=1)]
    if len(light) < count:
        raise ArmError(f"{arm.name}: its motors hold hardly any pose with {100 * HOLDING_SHARE:.0f} % of their effort")
    return light[:count]


def middle_pose(arm: Arm) -> NDArray[np.float64]:
    """(n,) of such poses the one nearest to the middle of the joint box, in ranges."""
    poses = tuning_poses(arm, 200, 0)
    width = arm.position_upper - arm.position_lower
    middle = 0.5 * (arm.position_upper + arm.position_lower)
    nearest: NDArray[np.float64] = poses[np.argmin(np.sum(((poses - middle) / width) ** 2, axis=1))]
    return nearest


def rounded_gains(joints: Iterable[tuple[float, float, float]]) -> Gains:
    """Of (kp, kd, ki) of each joint, to three digits: what is compared is what a file has."""
    return Gains(*([float(f"{value:.3g}") for value in column] for column in zip(*joints, strict=True)))


#: The paper's simulation (Rutfield, Zia, Boos, Santoso, Sujumnong, WPI 2015), from the controller node that the team
#: gave along with it: gains of the joints of an MTM.
_PUBLISHED_JOINTS = (
    *("outer_yaw", "shoulder_pitch", "elbow_pitch"),
    *("wrist_platform", "wrist_pitch", "wrist_yaw", "wrist_roll"),
)
_PUBLISHED_KP = (0.5, 0.8, 0.85, 3.7, 0.5, 0.02, 0.006)
_PUBLISHED_KV = (1.95, 0.95, 1.75, 0.2, 0.1, 0.8, 0.08)
_PUBLISHED_KI = (1e-5, 5e-5, 1e-4, 4e-4, 1e-6, 1e-7, 1e-8)
#: The controller ran at 100 Hz and summed errors sample by sample: 1 of its Ki is 100 N m/(rad s).
_PUBLISHED_RATE = 100.0


def published_gains(arm: Arm) -> Gains | None:
    """Of an arm with the joints of an MTM, per second; None of another one, for which none were published."""
    if arm.joint_names != _PUBLISHED_JOINTS:
        return None
    return Gains(list(_PUBLISHED_KP), list(_PUBLISHED_KV), [_PUBLISHED_RATE * ki for ki in _PUBLISHED_KI])


#: Period of the controller and step of the plant [s].
PERIOD = 1e-3


@dataclass(frozen=True)
class Condition:
    """How the simulated arm differs from what its controller and its tuner know.

    Attributes:
        name: of the condition, in tables.
        gravity: the true gravity torque over the modelled one.
        inertia: every true mass and inertia over the modelled one; the controller is told how much heavier the arm is.
        ticks: time steps of delay beyond the arm's own.
    """

    name: str
    gravity: float = 1.0
    inertia: float = 1.0
    ticks: int = 0


NOMINAL = Condition("modelled")


@dataclass(frozen=True, eq=False)
class Response:
    """Of the n joints at m times [s; rad, N m; m, N on a prismatic joint].

    Attributes:
        t: (m,).
        q: (m, n) where the arm is.
        q_measured: (m, n) where its encoders say that it is, late.
        effort: (m, n) what the controller commands.
        q_desired: (n,).
    """

    t: NDArray[np.float64]
    q: NDArray[np.float64]
    q_measured: NDArray[np.float64]
    effort: NDArray[np.float64]
    q_desired: NDArray[np.float64]


class Bench:
    """An arm with all of its `effects` under GravityPidController, which knows what an identification would find."""

    def __init__(self, arm: Arm, condition: Condition = NOMINAL) -> None:
        """Builds the loop; the first one of an arm in a process compiles its controller, which takes seconds."""
        self.arm = arm
        # Links that are heavier by a factor are as hard to hold as to accelerate: the controller is told the former.
        believed = condition.inertia / condition.gravity
        self._station = ArmStation(
            arm,
            plant_config=arm_plant_config(PERIOD),
            effects=_later(arm.effects, condition.ticks),
            modify_plant=lambda plant: _scale_rotors(plant, condition.inertia),
        )
        model = known_model(arm)
        model = model.with_scaled_parameters(np.full(len(model.base_parameters), believed))
        self._controller = GravityPidController(model, period=PERIOD)
        builder = DiagramBuilder()
        add_closed_loop(builder, self._station, self._controller)
        name = arm.name.lower()
        outputs = [self._station.GetOutputPort(f"{name}.{port}") for port in ("state_true", "state_estimated")]
        outputs.append(self._controller.GetOutputPort("effort"))
        self._logs = [LogVectorOutput(output, builder, PERIOD) for output in outputs]
        self._diagram = builder.Build()
        self._inertias = _scaled_links(self._station.plant, condition.inertia)

    def step(self, q: NDArray[np.float64], q_desired: NDArray[np.float64], gains: Gains, duration: float) -> Response:
        """The arm rests at q (n,), springs of its friction slack; at time 0 it is wanted at rest at q_desired (n,)."""
        root = self._diagram.CreateDefaultContext()
        station = self._station.GetMyMutableContextFromRoot(root)
        controller = self._controller.GetMyMutableContextFromRoot(root)
        self._station.SetLinkInertias(station, self._inertias)
        self._station.SetPositions(station, q)
        self._controller.SetGains(controller, gains)
        desired = np.concatenate([q_desired, np.zeros(self.arm.num_joints)])
        self._controller.GetInputPort("desired_state").FixValue(controller, desired)
        simulator = Simulator(self._diagram, root)
        simulator.AdvanceTo(duration)
        true, measured, effort = (log.FindLog(root).data().T.copy() for log in self._logs)
        n = self.arm.num_joints
        t = np.array(self._logs[0].FindLog(root).sample_times())
        return Response(t, true[:, :n], measured[:, :n], effort, np.array(q_desired))


def _later(effects: ArmEffects, ticks: int) -> ArmEffects:
    delay = effects.delay or DelayEffect()
    return dataclasses.replace(effects, delay=dataclasses.replace(delay, measurement=delay.measurement + ticks))


def _scale_rotors(plant: MultibodyPlant, factor: float) -> None:
    for actuator in map(plant.get_joint_actuator, plant.GetJointActuatorIndices()):
        actuator.set_default_rotor_inertia(factor * actuator.default_rotor_inertia())


def _scaled_links(plant: MultibodyPlant, factor: float) -> dict[str, SpatialInertia]:
    """Every link of the arm `factor` times as heavy; none if that changes nothing."""
    if factor == 1.0:
        return {}
    instance = plant.GetBodyByName("base_link").model_instance()
    links = [plant.get_body(i) for i in plant.GetBodyIndices(instance)]
    inertias = {link.name(): link.default_spatial_inertia() for link in links if link.name() != "base_link"}
    return {
        name: SpatialInertia(factor * M.get_mass(), M.get_com(), M.get_unit_inertia()) for name, M in inertias.items()
    }


@cache
def bench_of(arm: str, condition: Condition = NOMINAL) -> Bench:
    """The bench of an arm, by its name or file: one a process."""
    return Bench(load_arm(arm), condition)


class JointOnBench:
    """A `procedure.JointUnderTest`: the joint is released at `step` from the arm's middle pose, where it is wanted."""

    def __init__(self, bench: Bench, joint: int) -> None:
        """Of the arm's joint with this index; the others are held with the arm's own gains."""
        arm = bench.arm
        self._bench, self._joint = bench, joint
        self._q_desired = middle_pose(arm)
        self.step, self.count = float(step_size(arm)[joint]), float(arm.encoder_counts()[joint])
        self.band, self.effort_limit = float(band(arm)[joint]), float(effort_limits(arm)[joint])

    def respond(self, kp: float, kd: float, ki: float, duration: float) -> tuple[NDArray, NDArray]:
        """See `JointUnderTest`."""
        own, j = self._bench.arm.gains, self._joint
        columns = [list(values) for values in (own.kp, own.kd, own.ki)]
        for values, value in zip(columns, (kp, kd, ki), strict=True):
            values[j] = value
        q = self._q_desired.copy()
        q[j] += self.step
        response = self._bench.step(q, self._q_desired, Gains(*columns), duration)
        return response.t, np.asarray(response.q_measured[:, j] - self._q_desired[j])
