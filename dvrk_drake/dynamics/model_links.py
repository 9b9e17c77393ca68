"""The links of an identified model: bodies that a simulator can use."""

from __future__ import annotations

import numpy as np

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import LinkInertia
from dvrk_drake.dynamics.nearest_links import nearest_links


def model_links(model: IdentifiedModel) -> tuple[LinkInertia, ...]:
    """Every moving link, with inertias that have the model's gravity base parameters.

    A static model knows no more than these: the links are those nearest to the SDF's.

    Raises:
        ModelError: no bodies have these base parameters.
    """
    return nearest_links(model.load_arm(), np.array([p.value for p in model.base_parameters]))


def not_in_links(model: IdentifiedModel) -> list[str]:
    """What the model's torque has beside its links, a line each, for people."""
    remarks = []
    if effects := [f"{e.joint} {e.kind} {e.value:+.4g}" for e in model.joint_effects]:
        remarks.append(f"joint effects [N m; N if prismatic]: {', '.join(effects)}")
    if doubted := [f"{j.name} {j.trust:g}" for j in model.joints if j.trust != 1.0]:
        remarks.append(f"trust below 1: {', '.join(doubted)}")
    return remarks
