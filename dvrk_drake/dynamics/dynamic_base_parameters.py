"""The base parameters of an arm's full dynamics: what any motion can tell of its links and rotors, readably named."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody

from dvrk_drake.dynamics.base_parameters import BaseParameters, StandardParameter, reduce_to_base
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.gravity_regressor import named_lengths
from dvrk_drake.dynamics.inertial_parameters import PARAMETER_NAMES, change_of_frame, parameter_axis
from dvrk_drake.dynamics.symbolic_plant import labelled_bodies
from dvrk_drake.models.plant import make_arm_plant

_AXES = tuple(parameter_axis(name) for name in PARAMETER_NAMES)


@dataclass(frozen=True, eq=False)
class DynamicBaseParameters:
    """beta = base.combination phi_F, with tau = Y_base beta = Y phi for every motion.

    phi_F (p,) are the ten parameters of each link about the origin and along the axes of its frame dh_<label> (a link
    that has none: its SDF frame), then the rotors'; `base.names` are written in them. phi (p,) are those of
    `DynamicRegressor`, about the links' own origins.

    Attributes:
        standard_parameters: (p,) phi_F.
        base: the combinations.
        to_links: (p, p) phi = to_links phi_F.
    """

    standard_parameters: tuple[StandardParameter, ...]
    base: BaseParameters
    to_links: NDArray[np.float64]

    @cached_property
    def combination(self) -> NDArray[np.float64]:
        """(b, p) with beta = combination phi."""
        return np.asarray(np.linalg.solve(self.to_links.T, self.base.combination.T).T, dtype=np.float64)


def derive_base_parameters(model: DynamicRegressor, coupled_rotors: bool = True) -> DynamicBaseParameters:
    """Reduces the regressor at random states, chosen so that gravity, velocity and acceleration weigh about the same.

    They are those of the arm as it is mounted: tilting it can bring parameters of the first links into the torque.

    Args:
        model: of the arm.
        coupled_rotors: False leaves out what couples two rotors, which no motor has (see `rotor_inertias`); p is less
            by these, the last columns of the regressor.

    Raises:
        ArmError: the arm's SDF has no frames dh_1, dh_2, ...
    """
    plant = make_arm_plant(model.arm)
    bodies = labelled_bodies(plant, "dh")
    frames = _link_frames(model, plant, bodies)
    rotors = [rotor for rotor in model.rotors if coupled_rotors or rotor.actuators[0] == rotor.actuators[1]]
    p = len(model.values) - len(model.rotors) + len(rotors)
    to_links = np.eye(p)
    parameters = []
    for i, (label, X_LF) in enumerate(frames):
        to_links[10 * i : 10 * i + 10, 10 * i : 10 * i + 10] = change_of_frame(X_LF)
        parameters += [StandardParameter(label, axis) for axis in _AXES]
    for rotor in rotors:
        a, b = (model.arm.joint_names.index(name) for name in rotor.actuators)
        label = f"{a + 1}" if a == b else f"{a + 1},{b + 1}"
        parameters.append(StandardParameter(label, "a", slides=bool(a == b and model.arm.prismatic[a])))
    base = reduce_to_base(
        _regressor_at_random_states(model)[:, :p] @ to_links,
        parameters,
        _readable_preference(parameters, _hinge_axes(plant, model, frames)),
        _named_coefficients(named_lengths(plant, bodies)),
    )
    return DynamicBaseParameters(tuple(parameters), base, to_links)


def _link_frames(
    model: DynamicRegressor, plant: MultibodyPlant, bodies: dict[str, tuple[RigidBody, RigidTransform]]
) -> list[tuple[str, RigidTransform]]:
    """Label and X_LF of each link of the model; a link without a dh frame is called as in the SDF, less its "_link"."""
    named = {body.name(): (label, X_LF) for label, (body, X_LF) in bodies.items()}
    return [named.get(link.link, (link.link.removesuffix("_link"), RigidTransform())) for link in model.links]


def _regressor_at_random_states(model: DynamicRegressor) -> NDArray[np.float64]:
    """(rows, p), three times as many as columns."""
    generator = np.random.default_rng(0)
    shape = (3 * len(model.values) // model.arm.num_joints + 1, model.arm.num_joints)
    q, v, vd = generator.uniform(-2, 2, shape), generator.normal(0, 2, shape), generator.normal(0, 5, shape)
    return model.regressor(q, v, vd).reshape(-1, len(model.values))


def _hinge_axes(
    plant: MultibodyPlant, model: DynamicRegressor, frames: list[tuple[str, RigidTransform]]
) -> dict[str, int]:
    """Label -> which axis of its frame F (0, 1, 2) the link turns about, for links that turn about one."""
    axes = {}
    for link, (label, X_LF) in zip(model.links, frames, strict=True):
        joints = (plant.get_joint(i) for i in plant.GetJointIndices())
        (joint,) = (joint for joint in joints if joint.child_body().name() == link.link)
        if joint.type_name() == "revolute":
            axis_L = joint.frame_on_child().GetFixedPoseInBodyFrame().rotation() @ joint.revolute_axis()
            axes[label] = int(np.argmax(np.abs(X_LF.rotation().inverse() @ axis_L)))
    return axes


def _readable_preference(parameters: list[StandardParameter], hinge_axes: dict[str, int]) -> list[int]:
    """Columns in the order in which they become base parameters.

    A link that turns about its axis u gives its mass, its first moment along u and one of its moments of inertia
    across u to the link before it (Khalil and Dombre, "Modeling, Identification and Control of Robots", 9.4.2): these
    come last, and from the base. Numbered links come before those of the linkage, which are read as additions to them,
    and rotors last of all but masses.
    """

    def given_away(p: StandardParameter) -> bool:
        if not p.axis:
            return True
        u = hinge_axes.get(p.label)
        across = [axis for axis in range(3) if axis != u]
        return u is not None and p.axis in ("xyz"[u], 2 * "xyz"[across[-1]])

    def key(index: int) -> tuple:
        p = parameters[index]
        number = int(p.label) if p.label.isdigit() else math.inf
        rotor = p.axis == "a"
        return (not p.axis, rotor, given_away(p), number == math.inf, number if given_away(p) else -number, index)

    return sorted(range(len(parameters)), key=key)


def _named_coefficients(lengths: dict[str, float]) -> dict[str, float]:
    """1, the lengths, and what inertias have in front of moments and masses: products, squares, ratios of two."""
    lengths = {name: length for name, length in lengths.items() if name != "1"}
    named = {**lengths, **{f"{name}^2": length**2 for name, length in lengths.items()}}
    for (a, x), (b, y) in itertools.permutations(lengths.items(), 2):
        named |= {
            f"{a} {b}": x * y,
            f"({a}^2 + {b}^2)": x**2 + y**2,
            f"({a}^2 - {b}^2)": x**2 - y**2,
            f"{a}/{b}": x / y,
        }
    return {"1": 1.0, "2": 2.0, **named, **{f"2 {name}": 2 * size for name, size in named.items()}}
