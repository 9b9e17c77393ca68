"""A hand that leads the paper's arm along a path through random poses."""

from __future__ import annotations

from dataclasses import dataclass

from dvrk_drake.dynamics.friction_compensation import Friction
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.experiments.reproduction.published import PAPER_ARM
from dvrk_drake.experiments.transparency import Compensation, Felt, feel, rambling_path
from dvrk_drake.models.arm import Arm, load_arm


@dataclass(frozen=True, eq=False)
class Lead:
    """One hand on one arm, as a process can be given it; `model` is a file, "" for limp motors."""

    name: str
    arm: Arm
    model: str
    friction_ratio: float
    poses: int
    seed: int


def led(lead: Lead) -> Felt:
    """What the hand feels along a path through random poses."""
    model = IdentifiedModel.load(lead.model) if lead.model else None
    # Which friction there is, a controller knows from the same files as the arm; its weight it has to identify.
    friction = Friction.of_arm(load_arm(PAPER_ARM))
    compensation = Compensation(lead.name, model, lead.friction_ratio, friction)
    path = rambling_path(lead.arm, lead.poses, seed=lead.seed)
    return feel(lead.arm, path, compensation, effects=lead.arm.effects, seed=lead.seed)
