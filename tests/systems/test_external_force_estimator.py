"""Online estimation of the external force: known forces, low-pass, dry friction at rest, invalid inputs."""

import numpy as np
import pytest
from pushed_arm import pushed_arm

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import PRIOR_FORCE, ArmFrame, Contact, is_measurable
from dvrk_drake.dynamics.momentum_observer import MomentumObserver
from dvrk_drake.errors import ArmError, ControllerError, ModelError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.external_force_estimator import ExternalForceEstimator

pytestmark = [pytest.mark.numeric, pytest.mark.drake_api]

FORCE = np.array([1.0, -2.0, 3.0])
PSM = load_arm("psm")
Q = np.array([[0.2, 0.3, 0.1, 0.0, 0.0, 0.0, 0.0]])
SMALL = 1e-4 * np.eye(7)[None]


@pytest.fixture(scope="module")
def pushed():
    return pushed_arm(seconds=1.5, force=FORCE)


@pytest.fixture(scope="module")
def resting():
    return pushed_arm(seconds=0.3, at_rest=True)


def run(system, recording, rows=None):
    """Returns the context after the updates with the measurements of a recording."""
    context = system.CreateDefaultContext()
    for q, v, tau in list(zip(recording.q, recording.qd, recording.tau, strict=True))[:rows]:
        system.GetInputPort("state_estimated").FixValue(context, np.concatenate([q, v]))
        system.GetInputPort("effort_measured").FixValue(context, tau)
        system.ExecuteForcedEvents(context)
    return context


def read(system, context, *names):
    return [system.GetOutputPort(name).Eval(context) for name in names]


def test_known_force_is_recovered_in_motion(pushed):
    model, recording = pushed
    system = ExternalForceEstimator(model, bandwidth=20.0)
    force, measurable, fault = read(system, run(system, recording), "force", "measurable", "fault")
    np.testing.assert_allclose(force, FORCE, atol=0.1)
    assert np.all(measurable == 1) and fault == 0


def test_observer_is_the_low_pass_of_the_inverse_dynamics(pushed):
    model, recording = pushed
    observer, rows = MomentumObserver(model, bandwidth=20.0), 300
    state, low_passed = observer.start(), np.zeros(7)
    vd = np.vstack([np.zeros(7), np.diff(recording.qd, axis=0) * 1000.0])[:rows]
    q, v, tau = recording.q[:rows], recording.qd[:rows], recording.tau[:rows]
    inverse_dynamics = PSM.transmission.pull_back_effort(model.dynamic_model.effort(q, v, vd))
    for k in range(rows):
        observer.update(state, q[k], v[k], tau[k])
        low_passed += (1 - np.exp(-0.02)) * (inverse_dynamics[k] - tau[k] - low_passed)
    np.testing.assert_allclose(observer.effort(state), low_passed, atol=1e-9)


def test_interval_contains_dry_friction_only_at_rest(pushed, resting):
    deviations = []
    for model, recording in (pushed, resting):
        system = ExternalForceEstimator(model)
        covariance = read(system, run(system, recording), "effort_covariance")[0].reshape(7, 7)
        deviations.append(np.sqrt(np.diag(covariance)))
    dry = {e.coordinate: 0.0 for e in resting[0].dynamics.effects}
    for e in resting[0].dynamics.effects:
        dry[e.coordinate] += e.coefficient * (e.kind in ("coulomb", "presliding"))
    assert np.all(deviations[1][:3] >= [dry[f"actuator.{j}"] / np.sqrt(3) for j in PSM.joint_names[:3]])
    assert np.all(deviations[0][:3] < deviations[1][:3])


def test_interval_contains_zero_without_a_force(resting):
    model, recording = resting
    system = ExternalForceEstimator(model)
    force, covariance = read(system, run(system, recording), "force", "force_covariance")
    assert np.all(np.abs(force) < 1.96 * np.sqrt(np.diag(covariance.reshape(3, 3))))


def test_contact_is_detected_at_the_stated_rate(pushed, resting):
    system = ExternalForceEstimator(pushed[0])
    assert read(system, run(system, pushed[1]), "contact")[0] == 1
    assert read(system, run(system, resting[1]), "contact")[0] == 0
    # Independent normal errors exceed the threshold at the stated rate.
    observer, generator = MomentumObserver(pushed[0], bandwidth=20.0), np.random.default_rng(0)
    rate = 0.01 * 3600 * observer.bandwidth / 2
    alarms = np.sum(generator.normal(size=(100_000, 7)) ** 2, axis=1) > observer.threshold(rate / 100)
    np.testing.assert_allclose(np.mean(alarms), 1e-4, atol=5e-5)


def test_fault_restarts_the_estimate(pushed):
    model, recording = pushed
    system = ExternalForceEstimator(model)
    context = run(system, recording, 50)
    system.GetInputPort("effort_measured").FixValue(context, np.full(7, np.nan))
    system.ExecuteForcedEvents(context)
    force, measurable, effort, fault = read(system, context, "force", "measurable", "external_effort", "fault")
    assert fault == 1 and not np.any(measurable) and not np.any(force) and not np.any(effort)
    system.GetInputPort("effort_measured").FixValue(context, recording.tau[50])
    system.ExecuteForcedEvents(context)
    assert read(system, context, "fault")[0] == 0


def test_direction_without_leverage_is_refused():
    # At the remote centre, an axial force acts on the insertion only, and a lateral force on no joint.
    X_BS = ArmFrame(PSM, PSM.frames.shaft).pose(Q[0])
    at_remote = Contact(PSM, PSM.frames.shaft, X_BS.inverse() @ np.zeros(3), axes="frame")
    _, covariance = at_remote.force(Q, np.zeros((1, 7)), SMALL)
    np.testing.assert_array_equal(is_measurable(covariance[0]), [False, False, True])
    np.testing.assert_allclose(np.diag(covariance[0])[:2], PRIOR_FORCE**2, atol=1e-6)


def test_cannula_makes_the_axial_force_uncertain():
    axis = ArmFrame(PSM, PSM.frames.shaft).pose(Q[0]).rotation().matrix()[:, 2]
    free, held = (
        axis @ Contact(PSM, cannula=cannula).force(Q, np.zeros((1, 7)), SMALL)[1][0] @ axis for cannula in (False, True)
    )
    assert held > 10 * free


def test_invalid_arguments_give_one_line(pushed):
    model, _ = pushed
    nominal = IdentifiedModel.from_arm(PSM)
    for error, message, make in (
        (ModelError, "requires a model that was identified from a motion", lambda: ExternalForceEstimator(nominal)),
        (
            ModelError,
            "does not state its errors",
            lambda: ExternalForceEstimator(IdentifiedModel.from_arm(PSM, dynamics=True)),
        ),
        (ControllerError, "bandwidth between 0 and 1 / period", lambda: ExternalForceEstimator(model, bandwidth=-1)),
        (
            ControllerError,
            "false alarms per hour must be",
            lambda: ExternalForceEstimator(model, false_alarms_per_hour=0.0),
        ),
        (ArmError, 'no frame "tip"', lambda: Contact(PSM, "tip")),
        (ArmError, "direction is 0", lambda: Contact(PSM, direction=[0, 0, 0])),
        (ArmError, "point is", lambda: Contact(PSM, point=[0, np.nan, 0])),
        (ArmError, "no shaft", lambda: Contact(load_arm("mtml"), cannula=True)),
    ):
        with pytest.raises(error, match=message):
            make()
