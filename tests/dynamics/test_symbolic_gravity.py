"""Compares the symbolic gravity torque with the paper, the dVRK's controller and the numeric plant."""

import numpy as np
import pytest
import sympy
from paper_regressor import paper_regressor

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.holding_torque import static_model
from dvrk_drake.dynamics.symbolic_gravity import GRAVITY, SymbolicPlant, derive_gravity
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import holding_torque, make_arm_plant, set_arm_positions

pytestmark = [pytest.mark.numeric, pytest.mark.drake_api]


@pytest.fixture(scope="module")
def arm():
    return load_arm("mtmr")


@pytest.fixture(scope="module", params=["mtmr", "psm"])
def any_arm(request):
    return load_arm(request.param)


@pytest.fixture(scope="module")
def random_q():
    return np.random.default_rng(3).uniform(-np.pi, np.pi, (40, 7))


def evaluate(gravity, q):
    """Evaluates the symbolic regressor with sympy, independently of `codegen`."""
    function = sympy.lambdify([*gravity.q, GRAVITY], gravity.regressor, modules="numpy")
    return np.array([np.array(function(*pose, 9.81), dtype=float) for pose in q])


def test_regressor_is_that_of_the_paper_in_other_frames(arm, random_q):
    """The frames of the paper and of the dVRK differ only by signs and by the order of the parameters."""
    ours = evaluate(derive_gravity(arm), random_q).reshape(-1, 12)
    paper = 9.81 * np.concatenate([paper_regressor(q) for q in random_q])
    T = np.linalg.lstsq(ours, paper, rcond=None)[0]
    np.testing.assert_allclose(ours @ T, paper, atol=1e-12)
    np.testing.assert_allclose(np.sort(np.abs(T)), np.repeat([[0.0] * 11 + [1.0]], 12, axis=0), atol=1e-12)


def test_dvrk_controller_mapping(arm):
    """Tests columns 0 to 9 of the regressor of the dVRK's controller."""
    gravity = derive_gravity(arm)
    numbers = dict(zip(gravity.base.names, gravity.base_values, strict=True))
    q = np.random.default_rng(0).uniform(-1, 1, (20, 7))
    s2, c2, s4, s5, s6 = np.sin(q[:, 1]), np.cos(q[:, 1]), np.sin(q[:, 3]), np.sin(q[:, 4]), np.sin(q[:, 5])
    c4, c5, c6 = np.cos(q[:, 3]), np.cos(q[:, 4]), np.cos(q[:, 5])
    S, C = np.sin(q[:, 1] + q[:, 2]), np.cos(q[:, 1] + q[:, 2])
    p = {
        "L2 (m2+...+m7) + m2 c2x + m_coupler c_coupler_x": s2,
        "m2 c2y + m_coupler c_coupler_y": c2,
        "L3 (m3+...+m7) + L_crank m_coupler + m3 c3x + m_crank c_crank_x": C,
        "L4 (m4+...+m7) + m3 c3z + m4 c4y + m_crank c_crank_y": -S,
        "m4 c4x": C * c4,
        "-m4 c4z + m5 c5y": -C * s4,
        "m5 c5z + m6 c6y": -(S * c5 + C * c4 * s5),
        "m5 c5x": C * c4 * c5 - S * s5,
        "m6 c6z + m7 c7z": C * s4 * s6 + S * c6 * s5 - C * c4 * c5 * c6,
        "m6 c6x": C * c6 * s4 - S * s5 * s6 + C * c4 * c5 * s6,
    }
    tau2 = 9.81 * sum(numbers[name] * column for name, column in p.items())
    model = static_model(arm)
    theta = gravity.base_values.copy()
    for name in ("m7 c7x", "m7 c7y"):
        theta[gravity.base.names.index(name)] = 0.0
    np.testing.assert_allclose(model.torque(q, theta)[:, 1], tau2, atol=1e-12)


@pytest.mark.parametrize(
    "direction", [(3.0, -2.0, -9.0), *(pytest.param(g, marks=pytest.mark.slow) for g in ((0, 0, -9.81), (0, 9.81, 0)))]
)
def test_torque_equals_the_holding_torque_of_the_plant(any_arm, random_q, direction):
    mounted = any_arm.with_gravity(direction)
    model = static_model(mounted)
    plant = make_arm_plant(mounted)
    context = plant.CreateDefaultContext()
    expected = []
    for q in random_q:
        set_arm_positions(plant, context, mounted, q)
        expected.append(holding_torque(plant, context, mounted))
    beta = model.gravity.base_values
    np.testing.assert_allclose(model.regressor(random_q) @ beta, expected, atol=1e-12)
    np.testing.assert_allclose(model.torque(random_q, beta), expected, atol=1e-12)
    np.testing.assert_allclose(model.torque(random_q[0], beta), expected[0], atol=1e-12)
    stacked = model.regressor(random_q).reshape(-1, len(beta))
    assert np.linalg.matrix_rank(stacked) == len(beta)


def test_torque_is_the_gradient_of_the_potential(any_arm, random_q):
    arm, gravity = any_arm, derive_gravity(any_arm)
    gradient = sympy.Matrix(gravity.potential).T.jacobian(gravity.q).T
    difference = sympy.lambdify([*gravity.q], (gradient - gravity.regressor).subs(GRAVITY, 9.81), modules="numpy")
    assert max(np.abs(np.array(difference(*q), float)).max() for q in random_q) < 1e-12
    potential = sympy.lambdify([*gravity.q], gravity.potential.subs(GRAVITY, 9.81), modules="numpy")
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    constants = []
    for q in random_q:
        set_arm_positions(plant, context, arm, q)
        actual = (np.array(potential(*q), float) @ gravity.base_values)[0]
        constants.append(plant.CalcPotentialEnergy(context) - actual)
    assert np.ptp(constants) < 1e-12


@pytest.mark.parametrize(
    ("name", "labels"),
    [
        ("mtmr", "1 2 3 4 5 6 7 crank coupler"),
        ("psm", "1 2 3 4 5 6 back_crank bottom_bar top_bar front_crank counterweight finger_1 finger_2"),
    ],
)
def test_symbolic_frames_equal_those_of_the_plant(random_q, name, labels):
    arm = load_arm(name)
    symbolic = SymbolicPlant(arm)
    poses = symbolic.frame_poses()
    assert set(poses) == set(labels.split())
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    zero = plant.GetFrameByName("dh_0")
    for label, X_0F in poses.items():
        frame = plant.GetFrameByName(f"dh_{label}")
        function = sympy.lambdify([*symbolic.q], X_0F, modules="numpy")
        for q in random_q[:10]:
            set_arm_positions(plant, context, arm, q)
            np.testing.assert_allclose(
                np.array(function(*q), float), frame.CalcPose(context, zero).GetAsMatrix4(), atol=1e-12
            )


def test_joint_effects_add_their_torque(arm):
    effects = (ActuatorEffect("joint.wrist_platform", "cable sine", 1.0), ActuatorEffect("joint.outer_yaw", "offset"))
    plain, model = static_model(arm), static_model(arm, effects)
    q = np.random.default_rng(0).normal(size=(5, 7))
    beta = plain.gravity.base_values
    extra = model.torque(q, [*beta, 0.3, -0.2]) - plain.torque(q, beta)
    expected = np.zeros((5, 7))
    expected[:, 3], expected[:, 0] = 0.3 * np.sin(q[:, 3]), -0.2
    np.testing.assert_allclose(extra, expected, atol=1e-12)
