"""Imports the modules of controllers and arms, once for all processes that are forked afterwards."""

import lcm_controller  # noqa: F401

from dvrk_drake.processes import arm_controller, simulated_arm  # noqa: F401
