"""Efforts that other models predict for the recording of a result: the SDF and, on request, a previous model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.motion_identification import DynamicIdentification
from dvrk_drake.analysis.motion_validation import DynamicValidation, filtered_efforts
from dvrk_drake.analysis.pose_validation import predict_static
from dvrk_drake.analysis.results import Identification, Validation
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ModelError


def baseline_efforts(
    result: Identification | Validation, previous: IdentifiedModel | None = None
) -> dict[str, NDArray[np.float64]]:
    """Returns the efforts (r, n) that other models predict for the (first) recording of a result [N m, N].

    The rows and the coordinates are those of the measured efforts of the result.

    Args:
        result: Result for static poses or for a motion.
        previous: Previous model of the arm, or None.

    Returns:
        Mapping from "SDF" and, with a previous model, "previous" to efforts.

    Raises:
        ModelError: The previous model belongs to another arm, or has no dynamics for a motion.
    """
    arm = result.model.arm
    if previous is not None and previous.arm.name != arm.name:
        raise ModelError(f"the previous model belongs to {previous.arm.name}, the recording to {arm.name}")
    is_motion = isinstance(result, DynamicIdentification | DynamicValidation)
    models = {"SDF": IdentifiedModel.from_arm(arm, dynamics=is_motion)}
    if previous is not None:
        models["previous"] = previous
    if isinstance(result, DynamicIdentification | DynamicValidation):
        grid = result.motions[0].grid if isinstance(result, DynamicIdentification) else result.grid
        return {name: filtered_efforts(model, grid) for name, model in models.items()}
    return {name: predict_static(model, result.recording) for name, model in models.items()}
