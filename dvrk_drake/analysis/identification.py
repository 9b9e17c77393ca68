"""Identifies a model of an arm from a recording of poses, or from one or more motions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from dvrk_drake.analysis.check.mounting import find_mounting, is_assumed
from dvrk_drake.analysis.check.recording_check import require_usable, with_power
from dvrk_drake.analysis.effects_at_rest import MIN_NUM_POSES, with_effects_at_rest
from dvrk_drake.analysis.estimation.gravity_direction import LARGE_TILT
from dvrk_drake.analysis.estimation.gravity_direction import estimate_gravity as gravity_direction
from dvrk_drake.analysis.motion_identification import DynamicIdentification, identify_dynamic
from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.observations.observations import Observations, Poses
from dvrk_drake.analysis.pose_identification import Method, StaticIdentification, identify_static
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
    recordings = [recording] if isinstance(recording, Recording) else list(recording)
    if not recordings:
        raise RecordingError("no recordings were given; a model requires at least one")
    if len(recordings) > 1 and method != "robust":
        raise RecordingError(f'method "{method}": requires one recording, but {len(recordings)} were given')
    if estimate_gravity:
        arm = replace(arm, identification=replace(arm.identification, base_may_tilt=True))
    names = [own.source or f"recording {i}" for i, own in enumerate(recordings, start=1)]
    warnings: list[Finding] = []

    def warn(name: str, findings: Iterable[Finding]) -> None:
        warnings.extend(finding.within(name) if len(recordings) > 1 else finding for finding in findings)

    for k, name in enumerate(names):
        recordings[k], dropped = with_power(recordings[k], arm)
        warn(name, dropped)
    if is_assumed(arm):
        arm, mounting = find_mounting(Observations(recordings[0], arm))
        warnings += mounting
    motions, static = _motions_and_poses(names, [Observations(own, arm).poses() for own in recordings])
    for name, poses in motions + static:
        report = require_usable(poses.observations, progress, channels=True)
        warn(name, report.warnings)
    share = step_progress(progress, "identifying")
    try:
        if not motions:
            identified = _identify_poses(static[0][1], method, estimate_gravity, share)
            return replace(identified, warnings=(*warnings, *identified.warnings))
        result = identify_dynamic([motion.observations for _, motion in motions], lambda done: share(0.95 * done))
        for _, poses in static:
            at_rest = identify_static(poses.recording, arm)
            model = with_effects_at_rest(result.model, at_rest)
            result = replace(result, model=model, note=_note(model, len(at_rest.recording)))
        share(1.0)
    except DvrkDrakeError as error:
        error.findings = tuple(warnings)
        raise
    return replace(result, warnings=(*warnings, *_unexplained(result)))


def _motions_and_poses(
    names: Sequence[str], recordings: Sequence[Poses]
) -> tuple[list[tuple[str, Poses]], list[tuple[str, Poses]]]:
    """Returns the motions and the static poses among the named recordings.

    Raises:
        RecordingError: Several recordings contain static poses, or two motions have the same efforts.
    """
    named = list(zip(names, recordings, strict=True))
    motions, static = ([(name, own) for name, own in named if own.moves == moves] for moves in (True, False))
    if len(static) > 1:
        raise RecordingError(
            f"{static[1][0]}: contains static poses, or is sampled too slowly for a motion, and so does "
            f"{static[0][0]}; several recordings can be combined only if all of them, or all but one, are motions"
        )
    for (name, own), (other_name, other) in combinations(motions, 2):
        pair = own.recording, other.recording
        efforts = [{row.tobytes() for row in x.measured_effort().round(9) if row.any()} for x in pair]
        if len(efforts[0] & efforts[1]) > MAX_COMMON_ROWS * min(map(len, pair)):
            raise RecordingError(
                f"{other_name}: contains the same efforts as {name}; give different recordings, because each of them "
                "is predicted from the others"
            )
    return motions, static


def _identify_poses(
    poses: Poses, method: Method, estimate_gravity: bool, progress: Callable[[float], object]
) -> StaticIdentification:
    """Returns the static model, with a warning if the base seems to be tilted."""
    arm, source, note = poses.observations.arm, poses.observations.source, poses.note
    direction, limit = gravity_direction(poses.recording, arm), f"{np.rad2deg(LARGE_TILT):g} deg"
    if estimate_gravity:
        if not direction.is_determined:
            raise IdentificationError(
                f"{source}: the poses do not determine the direction of gravity: {direction} from the arm file; at "
                f"most +- {limit} is allowed. Measure the tilt of the base and give the gravity vector, or record more "
                "poses over larger ranges."
            )
        arm = arm.with_gravity(direction.gravity.tolist())
        note = f"{note} Gravity in the base frame, estimated from the poses: {direction} from the arm file.".strip()
    static = identify_static(poses.recording, arm, method, progress)
    static = replace(static, note=note, num_rows=len(poses.recording))
    if estimate_gravity or not direction.is_large:
        return static
    static.model.provenance.base_tilt = f"gravity estimated from the poses: {direction} from the assumed direction"
    what = (
        f"the base seems to be tilted by more than {limit}. Gravity estimated from the poses: {direction} from the "
        "assumed direction. Cable terms of the model replace part of the tilt, so the model is wrong at other poses "
        "and in an exported file"
    )
    advice = "Measure the tilt and identify again with --gravity X Y Z."
    if direction.is_determined:
        advice = "Identify again with --gravity X Y Z, or with --gravity estimate."
    return replace(static, warnings=(Finding("warning", "base tilt", source, what, advice),))


def _note(model: IdentifiedModel, num_poses: int) -> str:
    effects = ", ".join(f"{ActuatorEffect.of(e)} {e.coefficient:+.4f}" for e in model.effects)
    few = f" ({MIN_NUM_POSES} poses are required)" if num_poses < MIN_NUM_POSES else ""
    return f"Corrections of the holding torque from {num_poses} static poses [N m; N]: {effects or 'none'}{few}."


def _unexplained(result: DynamicIdentification) -> tuple[Finding, ...]:
    actuators = result.model.dynamic_model.section.actuators
    return unexplained_effort({a.name: a.rms_cross_validation / a.rms_effort for a in actuators if a.rms_effort > 0})
