"""Simulated arm for tuning: properties that both tuning methods use, and a closed loop for step tests."""

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
from dvrk_drake.dynamics.inertial_parameters import moving_bodies
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.models.effects_schema import ArmEffects, DelayEffect, per_actuator
from dvrk_drake.systems.arm_station import ArmStation, arm_plant_config
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

#: Size of the test steps of a joint [rad, m].
STEP_REVOLUTE, STEP_PRISMATIC = 0.05, 0.005


def step_size(arm: Arm) -> NDArray[np.float64]:
    """Returns the step size (n,) of each joint [rad, m]."""
    return arm.per_joint(STEP_REVOLUTE, STEP_PRISMATIC)


def band(arm: Arm) -> NDArray[np.float64]:
    """Returns the settling band (n,) of each joint [rad, m]: 2 % of the step, and at least one encoder count."""
    return np.maximum(0.02 * step_size(arm), arm.encoder_counts())


def effort_limits(arm: Arm) -> NDArray[np.float64]:
    """Returns the maximum effort (n,) of each joint [N m, N] with zero effort of the other joints.

    The maximum effort is the smaller of the arm's effort limit and the effort that the motors can produce.
    """
    motors = per_actuator(arm.effects.saturation, arm.joint_names, np.inf)
    # Actuator efforts per unit of a single joint effort, since tau_joint = J' tau_actuator.
    share = np.abs(np.linalg.inv(arm.transmission.matrix).T)
    with np.errstate(divide="ignore"):
        return np.minimum(arm.effort_limits, np.min(motors[:, None] / share, axis=0))


def ideal_model(arm: Arm) -> IdentifiedModel:
    """Returns an exact model of the arm: the links of the SDF, and the springs and cables of the arm's file."""
    return IdentifiedModel.from_arm(arm, [*arm.effects.cables, *arm.effects.springs])


#: Maximum holding effort at tuning poses, as a share of the motor's maximum effort. At other poses, a motor may
#: saturate for any gains.
MAX_HOLDING_SHARE = 0.5


@cache
def tuning_poses(arm: Arm, count: int, seed: int) -> NDArray[np.float64]:
    """Returns random poses (count, n) with low holding efforts and a margin of 10 % of each range from the stops.

    Raises:
        ArmError: Too few poses have a low holding effort.
    """
    candidates = arm.sample_poses(40 * count, np.random.default_rng(seed), margin=0.1)
    efforts = ideal_model(arm).holding_torque(candidates) @ np.linalg.inv(arm.transmission.matrix)
    motors = per_actuator(arm.effects.saturation, arm.joint_names, np.inf)
    suitable = candidates[np.all(np.abs(efforts) <= MAX_HOLDING_SHARE * motors, axis=1)]
    if len(suitable) < count:
        raise ArmError(
            f"{arm.name}: gravity requires more than {100 * MAX_HOLDING_SHARE:.0f} % of a motor's maximum effort "
            "at almost all poses. Check the inertias and motor limits of the arm."
        )
    return suitable[:count]


def middle_pose(arm: Arm) -> NDArray[np.float64]:
    """Returns the tuning pose (n,) nearest to the middle of the joint box. Distances are shares of the joint ranges."""
    poses = tuning_poses(arm, 200, 0)
    width = arm.position_upper - arm.position_lower
    middle = 0.5 * (arm.position_upper + arm.position_lower)
    nearest: NDArray[np.float64] = poses[np.argmin(np.sum(((poses - middle) / width) ** 2, axis=1))]
    return nearest


def rounded_gains(joints: Iterable[tuple[float, float, float]]) -> Gains:
    """Rounds (kp, kd, ki) of each joint to three digits, as in a gains file."""
    return Gains(*([float(f"{value:.3g}") for value in column] for column in zip(*joints, strict=True)))


#: Period of the controller and step of the plant [s].
PERIOD = 1e-3


@dataclass(frozen=True)
class Condition:
    """Difference between the simulated arm and the model that the controller and the tuning methods use.

    Attributes:
        name: Name of the condition in tables.
        gravity: Ratio of the true gravity torque to that of the model.
        inertia: Ratio of all true masses and inertias to those of the model. The gravity torque of the controller's
            model is scaled by the same ratio.
        ticks: Additional delay of the measurements in time steps.
    """

    name: str
    gravity: float = 1.0
    inertia: float = 1.0
    ticks: int = 0


NOMINAL = Condition("nominal")


@dataclass(frozen=True, eq=False)
class Response:
    """Step response of the n joints at m times.

    Attributes:
        t: Times (m,) [s].
        q: True positions (m, n) [rad, m].
        q_measured: Delayed positions (m, n) from the encoders [rad, m].
        effort: Commanded efforts (m, n) [N m, N].
        q_desired: Desired positions (n,) [rad, m].
    """

    t: NDArray[np.float64]
    q: NDArray[np.float64]
    q_measured: NDArray[np.float64]
    effort: NDArray[np.float64]
    q_desired: NDArray[np.float64]


class Bench:
    """Closed loop of an arm with all of its `effects` and a GravityPidController.

    The gravity model of the controller is exact except for the factor `gravity` of the condition.
    """

    def __init__(self, arm: Arm, condition: Condition = NOMINAL) -> None:
        """Builds the loop."""
        self.arm = arm
        # Heavier links increase both gravity and inertia. Scale the model so that true and modelled gravity have the
        # ratio `gravity`.
        model_scale = condition.inertia / condition.gravity
        self._station = ArmStation(
            arm,
            plant_config=arm_plant_config(PERIOD),
            effects=_with_additional_delay(arm.effects, condition.ticks),
            modify_plant=lambda plant: _scale_rotors(plant, condition.inertia),
        )
        model = ideal_model(arm)
        model = model.with_scaled_parameters(np.full(len(model.base_parameters), model_scale))
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
        """Simulates a step at time 0 from q (n,) to q_desired (n,).

        The arm starts at rest, and the presliding springs carry no force.
        """
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


def _with_additional_delay(effects: ArmEffects, ticks: int) -> ArmEffects:
    delay = effects.delay or DelayEffect()
    return dataclasses.replace(effects, delay=dataclasses.replace(delay, measurement=delay.measurement + ticks))


def _scale_rotors(plant: MultibodyPlant, factor: float) -> None:
    for actuator in map(plant.get_joint_actuator, plant.GetJointActuatorIndices()):
        actuator.set_default_rotor_inertia(factor * actuator.default_rotor_inertia())


def _scaled_links(plant: MultibodyPlant, factor: float) -> dict[str, SpatialInertia]:
    """Returns the inertias of the links scaled by `factor`, or an empty dict for a factor of 1."""
    if factor == 1.0:
        return {}
    inertias = {link.name(): link.default_spatial_inertia() for link in moving_bodies(plant)}
    return {
        name: SpatialInertia(factor * M.get_mass(), M.get_com(), M.get_unit_inertia()) for name, M in inertias.items()
    }


@cache
def bench_of(arm: str, condition: Condition = NOMINAL) -> Bench:
    """Returns the closed loop of an arm, given by its name or file. Each process caches its loops."""
    return Bench(load_arm(arm), condition)


class JointOnBench:
    """Implementation of `procedure.JointUnderTest`. Steps start at the distance `step` from the middle pose."""

    def __init__(self, bench: Bench, joint: int) -> None:
        """Selects the joint with this index. The other joints are regulated with the gains of the arm's file."""
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
