"""Compiles the controllers on import, once for all processes that are forked afterwards."""

import lcm_controller  # noqa: F401

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes import simulated_arm  # noqa: F401
from dvrk_drake.processes.arm_controller import ArmController

for name in ("mtml", "psm"):
    arm = load_arm(name)
    ArmController(arm, IdentifiedModel.from_arm(arm), "hold", 1e-3)
