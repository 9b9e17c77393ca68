"""Identifies a model of an arm from a recording of poses, or from one or more motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dvrk_drake.analysis.check.findings import Finding
from dvrk_drake.analysis.check.mounting import find_mounting, is_assumed
from dvrk_drake.analysis.check.recording_check import require_usable, with_power
from dvrk_drake.analysis.dynamic.dynamic_identification import DynamicIdentification, identify_dynamic
from dvrk_drake.analysis.effects_at_rest import MIN_NUM_POSES, with_effects_at_rest
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.static.gravity_direction import LARGE_TILT, GravityDirection
from dvrk_drake.analysis.static.gravity_direction import estimate_gravity as gravity_direction
from dvrk_drake.analysis.static.static_identification import Method, StaticIdentification, identify_static
from dvrk_drake.analysis.verdict import unexplained_effort
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import DvrkDrakeError, IdentificationError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.recording import Recording

#: Largest share of the rows of a motion that may occur in another motion. Real efforts do not repeat exactly.
MAX_COMMON_ROWS = 0.05


def identify(
    recording: Recording | Sequence[Recording],
    arm: Arm,
    *,
    method: Method = "robust",
    estimate_gravity: bool = False,
    progress: Progress | None = None,
) -> StaticIdentification | DynamicIdentification:
    """Checks a recording and identifies the arm's model from it, as `dvrk-drake identify` does.

    A recording of poses, or a motion with enough static poses, gives a static model with gravity, cables, springs and
    offsets. Any other motion gives a dynamic model with physically consistent inertial parameters, rotor inertias and
    friction.

    Several motions, for example of different days, give one dynamic model. The links, cables and springs are those of
    all motions. Offsets and friction may differ between the motions, and the model contains their means. The
    cross-validated errors are those of each motion with a model of the other motions.

    Motions and one recording of poses give one dynamic model. The poses correct its holding torques
    (`with_effects_at_rest`).

    Args:
        recording: Poses with efforts (m, n), or a motion with times and efforts, in joint or actuator coordinates. Or
            several motions, also with one recording of poses.
        arm: Arm that was recorded, with the gravity direction of its mounting, see `Arm.with_gravity`.
        method: Method for poses: "robust", or "paper" for the least squares of Rutfield et al. (2015).
        estimate_gravity: True to estimate the direction of gravity in the base frame, for a base with an unknown tilt.
            The vector of `arm` is the initial estimate. Motions of an MTM always give this estimate.
        progress: Callback that receives the name of the step ("checking the recording" or "identifying") and the
            finished share of the step (0 to 1).

    Returns:
        Result with the model as `model`, the recording used for the fit as `recording`, and `warnings`. The method
        `save` of the result writes the model file.

    Raises:
        RecordingError: The recording does not fit the arm, or `check` rejects the recording. The attribute `findings`
            of the error contains the reasons.
        IdentificationError: No model is identifiable from the recording.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> arm = dvrk.load_arm("mtmr")
        >>> generator = np.random.default_rng(0)
        >>> q = arm.sample_poses(40, generator)
        >>> tau = dvrk.IdentifiedModel.from_arm(arm).holding_torque(q)
        >>> tau += 0.003 * arm.effort_limits * generator.normal(size=q.shape)
        >>> result = dvrk.identify(dvrk.Recording(q=q, tau=tau), arm)
        >>> len(result.model.base_parameters), len(result.model.joints)
        (12, 7)
        >>> for warning in result.warnings:
        ...     print(warning)
        >>> result.save("model.yaml")
    """
    if estimate_gravity:
        arm = replace(arm, identification=replace(arm.identification, base_may_tilt=True))
    if not isinstance(recording, Recording):
        if len(recording) != 1:
            if method != "robust":
                raise RecordingError(f'method "{method}": requires one recording, but {len(recording)} were given')
            return _identify_several(recording, arm, progress)
        (recording,) = recording
    recording, dropped = with_power(recording, arm)
    if is_assumed(arm):
        arm, mounting = find_mounting(Observations(recording, arm))
        dropped = (*dropped, *mounting)
    poses = Observations(recording, arm).poses()
    report = require_usable(poses.observations, progress, channels=True)
    share = step_progress(progress, "identifying")
    try:
        if poses.moves:
            motion = identify_dynamic([poses.observations], share)
            return replace(motion, warnings=(*dropped, *report.warnings, *_unexplained(motion)))
        direction = gravity_direction(poses.recording, arm)
        if estimate_gravity:
            arm = _with_estimated_gravity(arm, direction, report.source)
        static = identify_static(poses.recording, arm, method, share)
    except DvrkDrakeError as error:
        error.findings = (*dropped, *report.warnings)
        raise
    note = poses.note
    if estimate_gravity:
        note = f"{note} Gravity in the base frame, estimated from the poses: {direction} from the arm file.".strip()
    tilted = () if estimate_gravity else _tilt_warning(direction, report.source)
    if tilted:
        static.model.provenance.base_tilt = f"gravity estimated from the poses: {direction} from the assumed direction"
    warnings = (*dropped, *report.warnings, *tilted)
    return replace(static, warnings=warnings, note=note, num_rows=len(poses.recording))


def _with_estimated_gravity(arm: Arm, direction: GravityDirection, source: str) -> Arm:
    if not direction.is_determined:
        raise IdentificationError(
            f"{source}: the poses do not determine the direction of gravity: {direction} from the arm file; at most +- "
            f"{np.rad2deg(LARGE_TILT):g} deg is allowed. Measure the tilt of the base and give the gravity vector, "
            "or record more poses over larger ranges."
        )
    return arm.with_gravity(direction.gravity.tolist())


def _tilt_warning(direction: GravityDirection, source: str) -> tuple[Finding, ...]:
    if not direction.is_large:
        return ()
    what = (
        f"the base seems to be tilted by more than {np.rad2deg(LARGE_TILT):g} deg. Gravity estimated from the poses: "
        f"{direction} from the assumed direction. Cable terms of the model replace part of the tilt, so the model is "
        "wrong at other poses and in an exported file"
    )
    advice = "Measure the tilt and identify again with --gravity X Y Z."
    if direction.is_determined:
        advice = "Identify again with --gravity X Y Z, or with --gravity estimate."
    return (Finding("warning", "base tilt", source, what, advice),)


def _identify_several(recordings: Sequence[Recording], arm: Arm, progress: Progress | None) -> DynamicIdentification:
    if not recordings:
        raise RecordingError("no recordings were given; a model requires at least one")
    motions: list[tuple[str, Observations]] = []
    static: list[tuple[str, Observations]] = []
    warnings: list[Finding] = []
    if is_assumed(arm):
        arm, mounting = find_mounting(Observations(with_power(recordings[0], arm)[0], arm))
        warnings += mounting
    for i, whole in enumerate(recordings):
        recording, dropped = with_power(whole, arm)
        name = recording.source or f"recording {i + 1}"
        warnings += [replace(finding, where=f"{name}: {finding.where}") for finding in dropped]
        found = Observations(recording, arm).poses()
        if not found.moves and (static or (i == len(recordings) - 1 and not motions)):
            also = f", and so does {static[0][0]}" if static else ""
            raise RecordingError(
                f"{name}: contains static poses, or is sampled too slowly for a motion{also}; several recordings can "
                "be combined only if all of them, or all but one, are motions"
            )
        for other_name, other in motions if found.moves else ():
            if _num_common_rows(recording, other.recording) > MAX_COMMON_ROWS * min(
                len(recording), len(other.recording)
            ):
                raise RecordingError(
                    f"{name}: contains the same efforts as {other_name}; give different recordings, because each of "
                    "them is predicted from the others"
                )
        (motions if found.moves else static).append((name, found.observations))
    for name, observations in motions + static:
        report = require_usable(observations, progress, channels=True)
        warnings += [replace(finding, where=f"{name}: {finding.where}") for finding in report.warnings]
    share = step_progress(progress, "identifying")
    try:
        result = identify_dynamic([motion for _, motion in motions], lambda done: share(0.95 * done))
        for _, observations in static:
            poses = identify_static(observations.recording, arm)
            model = with_effects_at_rest(result.model, poses)
            result = replace(result, model=model, note=_note(model, len(poses.recording)))
        share(1.0)
    except DvrkDrakeError as error:
        error.findings = tuple(warnings)
        raise
    return replace(result, warnings=(*warnings, *_unexplained(result)))


def _note(model: IdentifiedModel, num_poses: int) -> str:
    effects = ", ".join(f"{ActuatorEffect.of(e)} {e.coefficient:+.4f}" for e in model.effects)
    few = f" ({MIN_NUM_POSES} poses are required)" if num_poses < MIN_NUM_POSES else ""
    return f"Corrections of the holding torque from {num_poses} static poses [N m; N]: {effects or 'none'}{few}."


def _num_common_rows(a: Recording, b: Recording) -> int:
    """Returns the number of different effort rows that two recordings have in common, without rows of zeros."""
    rows = [{row.tobytes() for row in x.measured_effort().round(9) if row.any()} for x in (a, b)]
    return len(rows[0] & rows[1])


def _unexplained(result: DynamicIdentification) -> tuple[Finding, ...]:
    actuators = result.model.dynamic_model.section.actuators
    return unexplained_effort({a.name: a.rms_cross_validation / a.rms_effort for a in actuators if a.rms_effort > 0})
