"""The links and rotors of an identified model: bodies that a simulator can use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import LinkInertia
from dvrk_drake.dynamics.nearest_links import nearest_links
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.plant import make_arm_plant


@dataclass(frozen=True, eq=False)
class ModelBodies:
    """What a simulator can have of a model.

    Attributes:
        links: every moving link; a rotor that turns as a link does is part of it, as in the SDF.
        rotors: joint -> inertia that its motors add to it [kg m^2; kg if prismatic]; empty: those of the SDF.
        left_out: what the model's torque has beside these, a line each, for people.
    """

    links: tuple[LinkInertia, ...]
    rotors: dict[str, float]
    left_out: list[str]


def model_bodies(model: IdentifiedModel) -> ModelBodies:
    """The links of the model's dynamics, and its rotors; of a static model the links nearest to the SDF's.

    A static model knows no more than gravity base parameters; its links have exactly these.

    Raises:
        ModelError: no bodies have these base parameters.
    """
    arm = model.load_arm()
    left_out = _static_effects(model)
    expected = load_arm(model.arm).gravity
    if not np.allclose(arm.gravity, expected, atol=0.02):
        gravity = ", ".join(f"{x:.3f}" for x in arm.gravity)
        left_out.append(
            f"gravity ({gravity}) m/s^2 in the base frame: set it in the world that the file is loaded into"
        )
    if model.dynamics is None:
        base_values = np.array([p.value for p in model.base_parameters])
        return ModelBodies(nearest_links(arm, base_values), {}, left_out)
    if effects := model.dynamics.effects:
        coordinates = dict.fromkeys(effect.coordinate for effect in effects)
        left_out.append(f"{len(effects)} effects in the drive (friction, cables, springs): {', '.join(coordinates)}")
    links = {link.link: np.array(link.parameters) for link in model.dynamics.links}
    rotors, lost = _place_rotors(arm, links, [rotor.value for rotor in model.dynamics.rotors])
    if lost:
        left_out.append(f"by what rotors couple joints, which SDF cannot say [kg m^2, largest]: {', '.join(lost)}")
    return ModelBodies(tuple(LinkInertia(name, phi) for name, phi in links.items()), rotors, left_out)


def _static_effects(model: IdentifiedModel) -> list[str]:
    remarks = []
    if effects := [f"{e.effect} {e.value:+.4g}" for e in model.effects]:
        remarks.append(f"effects [N m; N if prismatic]: {', '.join(effects)}")
    if doubted := [f"{j.name} {j.trust:g}" for j in model.joints if j.trust != 1.0]:
        remarks.append(f"trust below 1: {', '.join(doubted)}")
    return remarks


def _place_rotors(
    arm: Arm, links: dict[str, NDArray[np.float64]], inertias: list[float]
) -> tuple[dict[str, float], list[str]]:
    """Puts rotors on joints, or into `links` that turn with them; returns the joints' and the rotors that lose terms.

    A rotor adds I J_k' J_k to the mass matrix, J_k its row of the transmission. On a joint SDF has only the diagonal of
    that, which is all where one joint alone moves the motor. Where several do, a link that turns by J_k q takes it, as
    the SDF's own crank and motor_4 links do: about its axis, and half of it about the others, as bodies must.
    """
    plant = make_arm_plant(arm)
    turning = _turning_links(plant, arm)
    joints = np.zeros(arm.num_joints)
    lost = []
    for name, row, inertia in zip(arm.joint_names, arm.transmission.matrix, inertias, strict=True):
        same = [link for link, (rate, _) in turning.items() if np.allclose(rate, row, atol=1e-9)]
        if np.count_nonzero(row) > 1 and same:
            # Links that always turn alike feel it alike; the last of them is one of the linkage's, like the SDF's own.
            link = same[-1]
            axis = turning[link][1]
            links[link] = links[link] + inertia * np.concatenate([np.zeros(4), _about(axis)])
            continue
        joints += inertia * row**2
        if np.count_nonzero(row) > 1 and inertia > 0:
            coupling = inertia * np.outer(row, row)
            lost.append(f"{name} {np.abs(coupling - np.diag(np.diag(coupling))).max():.2g}")
    return {name: float(x) for name, x in zip(arm.joint_names, joints, strict=True)}, lost


def _about(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6,) Ixx .. Iyz of a rotor of inertia 1 about `axis`, and a half about all that are normal to it."""
    inertia = (np.eye(3) + np.outer(axis, axis)) / 2
    return np.concatenate([np.diag(inertia), inertia[[0, 0, 1], [1, 2, 2]]])


def _turning_links(plant: MultibodyPlant, arm: Arm) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Links on hinges: by which of q they turn about their hinge's axis (n,), parents with parallel hinges included,
    and that axis in the link's frame (3,)."""
    context = plant.CreateDefaultContext()
    turning: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
    axes: dict[str, NDArray[np.float64]] = {}
    for name, row in zip(arm.tree_joint_names, arm.linkage.matrix, strict=True):
        joint = plant.GetJointByName(name)
        if joint.type_name() != "revolute":
            continue
        X_WM = joint.frame_on_child().CalcPoseInWorld(context)
        link, parent = joint.child_body(), joint.parent_body().name()
        axis_W = X_WM.rotation() @ joint.revolute_axis()
        X_WL = link.EvalPoseInWorld(context)
        parallel = parent in turning and np.allclose(axes[parent], axis_W, atol=1e-9)
        rate = row + turning[parent][0] if parallel else row
        turning[link.name()] = rate, X_WL.rotation().inverse() @ axis_W
        axes[link.name()] = axis_W
    return turning
