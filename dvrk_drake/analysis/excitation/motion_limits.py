"""Limits and collisions of a designed motion, and a check of a motion that is independent of its design."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.analysis.excitation.periodic_motion import PeriodicMotion
from dvrk_drake.analysis.excitation.predicted_effort import PredictedEffort
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ExcitationError
from dvrk_drake.models.arm import Arm, SoftWalls
from dvrk_drake.models.arm_files import is_from_model_file
from dvrk_drake.models.arm_schema import POSITIONS
from dvrk_drake.models.environment import Environment
from dvrk_drake.models.plant import add_arm, base_body, set_arm_positions
from dvrk_drake.models.ranges import number_fault, within


class CollisionDetector:
    """Detects collisions at poses of one arm.

    Pairs of links are checked, except those that the collision filters of the SDF exclude. In the arms of this package,
    all pairs are excluded.
    """

    def __init__(self, arm: Arm, environment: Environment = Environment()) -> None:
        """Constructs the detector.

        Args:
            arm: Arm with collision shapes.
            environment: Fixed objects around the arm.
        """
        self._arm = arm
        builder = DiagramBuilder()
        self._plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
        self._instance = add_arm(self._plant, arm)
        environment.add_to(self._plant)
        self._plant.Finalize()
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._query_port, self._inspector = scene_graph.get_query_output_port(), scene_graph.model_inspector()
        self._graph_context = scene_graph.GetMyMutableContextFromRoot(self._context)
        self._plant_context = self._plant.GetMyMutableContextFromRoot(self._context)

    def tip(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the position (3,) of the tip, the frame `Arm.frames.hand`, in the base frame at a pose (n,) [m]."""
        set_arm_positions(self._plant, self._plant_context, self._arm, pose, self._instance)
        frame = self._plant.GetFrameByName(self._arm.frames.hand, self._instance)
        return np.asarray(frame.CalcPoseInWorld(self._plant_context).translation())

    def collision(self, pose: NDArray[np.float64]) -> str:
        """Returns the description of the first collision at a pose (n,), or "" if there is none."""
        plant, inspector, base = self._plant, self._inspector, base_body(self._plant, self._instance)
        set_arm_positions(plant, self._plant_context, self._arm, pose, self._instance)
        for pair in self._query_port.Eval(self._graph_context).ComputePointPairPenetration():
            ids = pair.id_A, pair.id_B
            bodies = [plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)) for geometry in ids]
            bodies.sort(key=lambda body: (body.model_instance() != self._instance, body.name()))
            # The base is mounted at the table or at another object, and objects may touch each other.
            if all(body.model_instance() != self._instance or body is base for body in bodies):
                continue
            return f"collision of {' and '.join(map(self._name, bodies))}"
        return ""

    def _name(self, body: RigidBody) -> str:
        if body.model_instance() == self._instance:
            return str(body.name())
        return "the table" if body.index() == self._plant.world_body().index() else str(body.scoped_name().get_full())


def first_collision(
    arm: Arm, q: NDArray[np.float64], environment: Environment = Environment()
) -> tuple[int, str] | None:
    """Returns the index of the first pose with a collision and its description, or None.

    Args:
        arm: Arm with collision shapes.
        q: Poses (m, n) [rad, m].
        environment: Fixed objects around the arm.
    """
    detector = CollisionDetector(arm, environment)
    return next(((i, what) for i, pose in enumerate(q) if (what := detector.collision(pose))), None)


#: Rate at which a motion is checked [Hz], and accepted rounding error of a limit, relative to the width of its range.
#: Between the times, the highest possible harmonic (20 Hz) grows by at most 0.2 % of its amplitude.
CHECK_RATE, ROUNDING = 1000.0, 1e-9
#: Rate at which collisions are checked [Hz]. Between the times, a joint moves by at most 0.06 rad or 4 mm at the
#: default speed limits.
COLLISION_RATE = 50.0
#: Largest distance between two poses at which a straight path is checked, as a share of each position range.
#: The tip of a PSM moves by at most 9 mm between such poses (300 random poses).
PATH_STEP = 0.01
#: Largest share of a position range at each end for a soft wall of a derived gain, so that half of the range is free. A
#: model file has no rotors, so the gain of a light joint with a strong motor can be far below that of a real drive.
MAX_DERIVED_WALL = 0.25


@dataclass(frozen=True)
class MotionLimits:
    """Limits of a designed motion. Position limits are those of the arm, including the coupled limits.

    Attributes:
        margin: Share of each position range that is not used, at each end.
        traverse_time: Shortest time in which a joint may cross its position range [s]. The speed limit is the range
            divided by this time, or `speed` if it is smaller.
        speed: Largest speed of revolute and prismatic joints [rad/s, m/s].
        speed_time: Shortest time in which a joint may reach its speed limit from rest [s].
        acceleration_time: Shortest time in which a joint may reach the acceleration limit [s].
        effort: Largest predicted effort, as a share of the effort limits. Dry friction is added to the prediction.
        positions: Name of a joint -> lower and upper limit of its position [rad, m], in addition to those of the arm.
        tip_box: Lower and upper corner (3,) of the box in the base frame that the tip must not leave [m], or None.
        environment: Fixed objects around the arm, with which it must not collide.

    Example:
        >>> import dvrk_drake as dvrk
        >>> limits = dvrk.MotionLimits(traverse_time=2.0, positions={"insertion": (0.05, 0.2)})
        >>> limits.of_arm(dvrk.load_arm("psm")).speed.round(2).tolist()
        [1.59, 0.93, 0.12, 3.0, 1.4, 1.4, 1.05]
    """

    margin: float = field(default=0.05, metadata=within(0.0, 0.4))
    traverse_time: float = field(default=1.0, metadata=within(0.1, 100.0, "s"))
    speed: tuple[float, float] = field(default=(3.0, 0.2), metadata=within(1e-3, 100.0, "rad/s or m/s"))
    speed_time: float = field(default=0.2, metadata=within(0.01, 100.0, "s"))
    acceleration_time: float = field(default=0.1, metadata=within(0.001, 100.0, "s"))
    effort: float = field(default=0.8, metadata=within(0.05, 1.0))
    positions: dict[str, tuple[float, float]] = field(default_factory=dict, metadata=POSITIONS)
    tip_box: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    environment: Environment = field(default_factory=Environment)

    def __post_init__(self) -> None:
        if fault := number_fault(self):
            raise ExcitationError(f"limits of the motion: {fault}")
        if not isinstance(self.environment, Environment):
            raise ExcitationError("limits of the motion: environment must be an Environment, see Environment.load")

    def of_arm(self, arm: Arm) -> JointLimits:
        """Returns the limits of the joints of an arm.

        Raises:
            ExcitationError: A joint in `positions` is unknown, or no position is allowed.
        """
        A, lower, upper = arm.limit_matrix()
        walls = SoftWalls.of(arm)
        wall_width = walls.width
        if is_from_model_file(arm):
            wall_width = np.where(wall_width < MAX_DERIVED_WALL * (upper - lower), wall_width, 0.0)
        width = np.maximum(self.margin * (upper - lower), wall_width)
        behind_walls = lower + width, upper - width
        if np.any(covered := 2 * width >= upper - lower):
            i, names = int(np.argmax(covered)), [*arm.joint_names, *(limit.name for limit in arm.coupled_limits)]
            raise ExcitationError(
                f"{arm.name}: no motion meets all limits: the soft wall of the guard covers the whole range of "
                f"{names[i]}, because its gain kp is small for its effort limit. State gains with a kp "
                f"{4 * width[i] / (upper[i] - lower[i]):.2g} times as large, or a smaller effort limit, in an arm file "
                "(dvrk-drake arm-file)"
            )
        inset = self.margin * (upper - lower)
        lower, upper = lower + inset, upper - inset
        n = arm.num_joints
        for name, (low, high) in self.positions.items():
            if name not in arm.joint_names:
                raise ExcitationError(f'unknown joint "{name}"; allowed: {", ".join(arm.joint_names)}')
            j = arm.joint_names.index(name)
            if not low < high:
                raise ExcitationError(f"{name}: the lower limit {low:g} must be less than the upper limit {high:g}")
            if not max(lower[j], low) < min(upper[j], high):
                raise ExcitationError(
                    f"{name}: no position is within {low:g}..{high:g}; allowed: {lower[j]:g}..{upper[j]:g}, the limits "
                    f"of {arm.name} with a margin of {100 * self.margin:g} %"
                )
            lower[j], upper[j] = max(lower[j], low), min(upper[j], high)
        speed = (arm.position_upper - arm.position_lower) / self.traverse_time
        speed = np.minimum(speed, arm.per_joint(*self.speed))
        acceleration = speed / self.speed_time
        return JointLimits(
            np.vstack([A, A]),
            np.concatenate([lower, behind_walls[0]]),
            np.concatenate([upper, behind_walls[1]]),
            np.concatenate([np.zeros(len(A)), walls.look_ahead]),
            speed,
            acceleration,
            acceleration / self.acceleration_time,
            self.effort * arm.effort_limits[:n],
        )


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Limits of the joints of one arm.

    Attributes:
        A, lower, upper, look_ahead: Position limits lower <= A (q + T v) <= upper. The first half of the k rows is that
            of `Arm.limit_matrix`, with T = 0. The second half is the soft walls of the command guard, see `SoftWalls`.
        speed, acceleration, jerk: Largest absolute values (n,).
        effort: Largest absolute joint efforts (n,) [N m, N].
    """

    A: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    look_ahead: NDArray[np.float64]
    speed: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    jerk: NDArray[np.float64]
    effort: NDArray[np.float64]

    def positions(self, q: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns A (q + T v) (m, k) for positions and velocities (m, n)."""
        return np.asarray(q @ self.A.T + self.look_ahead * (v @ self.A.T))


def execution_limits(environment: Environment) -> MotionLimits:
    """Returns the limits that every motion must meet before an arm follows it.

    The speed limit is slightly below that of the command guard with default settings.

    Args:
        environment: Fixed objects around the arm.
    """
    return MotionLimits(
        margin=0.0,
        traverse_time=0.55,
        speed=(10.0, 1.0),
        speed_time=0.05,
        acceleration_time=0.01,
        effort=0.95,
        environment=environment,
    )


def path_obstacle(
    arm: Arm, q_start: ArrayLike, q_end: ArrayLike, environment: Environment, model: IdentifiedModel | None = None
) -> str:
    """Returns why an arm cannot move on the straight path in joint space between two poses (n,), or "".

    The joints move by at most `PATH_STEP` of their ranges between two checked poses. A motor must hold each pose, and
    overcome its dry friction, with less than the effort of `execution_limits`.

    Args:
        arm: Arm to move.
        q_start, q_end: First and last pose (n,) [rad, m].
        environment: Fixed objects around the arm.
        model: Model that predicts the efforts, see `PredictedEffort`.
    """
    start, end = np.asarray(q_start, dtype=np.float64), np.asarray(q_end, dtype=np.float64)
    steps = int(np.ceil(np.max(np.abs(end - start) / (arm.position_upper - arm.position_lower)) / PATH_STEP)) + 1
    q = start + np.linspace(0, 1, steps + 1)[:, None] * (end - start)
    if collision := first_collision(arm, q, environment):
        return collision[1]
    predicted = PredictedEffort(arm, model)
    share = (np.abs(predicted.holding(q)) + predicted.dry_friction) / arm.effort_limits
    k, j = np.unravel_index(int(np.argmax(share)), share.shape)
    if share[k, j] <= execution_limits(environment).effort:
        return ""
    unit = "m" if arm.prismatic[j] else "rad"
    return (
        f"{arm.joint_names[j]} at {q[k, j]:.3g} {unit} needs {100 * share[k, j]:.0f} % of its effort limit to hold the "
        "arm and to overcome its friction"
    )


def motion_violations(
    motion: PeriodicMotion, arm: Arm, limits: MotionLimits, model: IdentifiedModel | None = None
) -> list[str]:
    """Returns a message for each limit that a motion exceeds, evaluated at 1 kHz.

    The check uses only the positions of the motion. Velocities, accelerations and jerks are their spectral derivatives,
    and efforts are computed with Drake's inverse dynamics.

    Args:
        motion: Motion of the arm.
        arm: Arm to move.
        limits: Limits of the motion.
        model: Model that predicts the efforts, see `PredictedEffort`. None: the SDF.
    """
    joints = limits.of_arm(arm)
    count = max(round(CHECK_RATE * motion.period), 4 * len(motion.sine[0]))
    t = np.arange(count) * motion.period / count
    q = motion.evaluate(t).q
    v, vd, jerk = (spectral_derivative(q, motion.period, order) for order in (1, 2, 3))
    names: Sequence[str] = [*arm.joint_names, *(limit.name for limit in arm.coupled_limits)]
    with_walls = [*names, *(f"{name}, with the soft wall of the guard," for name in names)]
    predicted = PredictedEffort(arm, model)
    effort = np.abs(predicted.by_drake(q, v, vd)) + predicted.dry_friction
    checks: list[tuple[str, Sequence[str], NDArray, NDArray, NDArray]] = [
        ("position", with_walls, joints.positions(q, v), joints.lower, joints.upper),
        *(
            (what, names, value, -limit, limit)
            for what, value, limit in (
                ("speed", v, joints.speed),
                ("acceleration", vd, joints.acceleration),
                ("jerk", jerk, joints.jerk),
                ("effort", effort, joints.effort),
            )
        ),
    ]
    if limits.tip_box is not None:
        lower, upper = (np.array(corner) for corner in limits.tip_box)
        checks.append(("tip", ("x", "y", "z"), tip_positions(arm, q), lower, upper))
    messages = []
    for what, of, value, lower, upper in checks:
        rounding = ROUNDING * (upper - lower)
        for j in np.flatnonzero(np.any((value < lower - rounding) | (value > upper + rounding), axis=0)).tolist():
            worst = int(np.argmax(np.maximum(value[:, j] - upper[j], lower[j] - value[:, j])))
            messages.append(
                f"{what} of {of[j]} is {value[worst, j]:.6g} at {t[worst]:.3f} s, outside "
                f"{lower[j]:.6g}..{upper[j]:.6g}"
            )
    if collision := first_collision(arm, q[:: round(CHECK_RATE / COLLISION_RATE)], limits.environment):
        row, what = collision
        messages.append(f"{what} at {row / COLLISION_RATE:.2f} s")
    return messages


def spectral_derivative(x: NDArray[np.float64], period: float, order: int) -> NDArray[np.float64]:
    """Returns a time derivative of periodic samples x (m, n) of one whole period [s]."""
    frequency = 2j * np.pi * np.fft.rfftfreq(len(x), period / len(x))
    spectrum = np.fft.rfft(x, axis=0)
    # Rounding errors at high frequencies would dominate the derivatives.
    spectrum[np.abs(spectrum) < 1e-13 * np.abs(spectrum).max()] = 0.0
    return np.asarray(np.fft.irfft(spectrum * frequency[:, None] ** order, len(x), axis=0))


def tip_positions(arm: Arm, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the positions (m, 3) of the tip in the base frame at poses q (m, n) [m], see `CollisionDetector.tip`."""
    detector = CollisionDetector(arm)
    return np.array([detector.tip(pose) for pose in q]).reshape(-1, 3)
