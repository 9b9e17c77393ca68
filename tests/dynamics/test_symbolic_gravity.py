"""Gravity: symbolic torque, numeric base parameters, the paper, the dVRK and the plant."""

import re

import numpy as np
import pytest
import sympy
from paper_regressor import paper_regressor

from dvrk_drake.dynamics import gravity_parameters as numeric
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.gravity_parameters import gravity_parameters, independent_columns, reduce_to_base
from dvrk_drake.dynamics.holding_torque import static_model
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.symbolic_gravity import GRAVITY, SymbolicPlant, derive_gravity
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import holding_torque, holding_torques, make_arm_plant, set_arm_positions

pytestmark = [pytest.mark.drake_api, pytest.mark.numeric]


ARM = load_arm("mtmr")


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


def test_regressor_is_that_of_the_paper_in_other_frames(random_q):
    """The frames of the paper and of the dVRK differ only by signs and by the order of the parameters."""
    ours = evaluate(derive_gravity(ARM), random_q).reshape(-1, 12)
    paper = 9.81 * np.concatenate([paper_regressor(q) for q in random_q])
    T = np.linalg.lstsq(ours, paper, rcond=None)[0]
    np.testing.assert_allclose(ours @ T, paper, atol=1e-12)
    np.testing.assert_allclose(np.sort(np.abs(T)), np.repeat([[0.0] * 11 + [1.0]], 12, axis=0), atol=1e-12)


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


def test_joint_effects_add_their_torque():
    effects = (ActuatorEffect("joint.wrist_platform", "cable sine", 1.0), ActuatorEffect("joint.outer_yaw", "offset"))
    plain, model = static_model(ARM), static_model(ARM, effects)
    q = np.random.default_rng(0).normal(size=(5, 7))
    beta = plain.gravity.base_values
    extra = model.torque(q, [*beta, 0.3, -0.2]) - plain.torque(q, beta)
    expected = np.zeros((5, 7))
    expected[:, 3], expected[:, 0] = 0.3 * np.sin(q[:, 3]), -0.2
    np.testing.assert_allclose(extra, expected, atol=1e-12)


# Compares numeric base parameters of gravity with base parameters from symbolic potential energies.


#: Name, offset from the parent joint [m] and axis of the joints of a UR-like arm. Three successive joints are parallel.
UR_LIKE = [
    ("pan", (0, 0, 0.18), "0 0 1"),
    ("lift", (0, 0.17, 0), "0 1 0"),
    ("elbow", (0.61, 0, 0), "0 1 0"),
    ("wrist_1", (0.57, 0, 0), "0 1 0"),
    ("wrist_2", (0, -0.12, 0), "0 0 -1"),
    ("wrist_3", (0, 0, -0.12), "0 1 0"),
]


def load_ur_like(folder, additional=""):
    """Loads the UR-like arm, whose SDF has additional elements."""
    place = np.zeros(3)
    parts = ['<link name="base_link"/><frame name="dh_0" attached_to="base_link"/>']
    for i, (name, offset, axis) in enumerate(UR_LIKE, start=1):
        place = place + offset
        parent = f"{UR_LIKE[i - 2][0]}_link" if i > 1 else "base_link"
        parts.append(
            f'<link name="{name}_link"><pose>{place[0]} {place[1]} {place[2]} 0 0 0</pose><inertial><mass>{i}</mass>'
            f"<pose>0.01 {0.02 * i} 0.03 0 0 0</pose><inertia><ixx>0.1</ixx><iyy>0.1</iyy><izz>0.1</izz></inertia>"
            f'</inertial></link><frame name="dh_{i}" attached_to="{name}_link"/><joint name="{name}" type="revolute">'
            f"<parent>{parent}</parent><child>{name}_link</child><axis><xyz>{axis}</xyz><limit><lower>-3</lower>"
            "<upper>3</upper><effort>100</effort></limit></axis></joint>"
        )
    model = f'<model name="ur">{"".join(parts)}{additional}</model>'
    (folder / "arm.sdf").write_text(f'<sdf version="1.9" xmlns:drake="http://drake.mit.edu">{model}</sdf>')
    names, ones = [name for name, _, _ in UR_LIKE], [1.0] * len(UR_LIKE)
    (folder / "mechanism.yaml").write_text(
        f"sdf: arm.sdf\njoints: {names}\ngains: {{kp: {ones}, kd: {ones}, ki: {ones}}}\n"
        f"motion: {{acceleration_cut_off: {ones}, effort_delay: {[0.0] * len(ones)}}}\n"
    )
    limits = ", ".join(f"{name}: [-3, 3]" for name in names)
    (folder / "arm.yaml").write_text(f"name: UR\nmechanism: mechanism.yaml\nposition_limits: {{{limits}}}\n")
    return load_arm(folder / "arm.yaml")


@pytest.fixture(scope="module")
def ur_like(tmp_path_factory):
    return load_ur_like(tmp_path_factory.mktemp("ur"))


def moving_link(name, parent, centre_of_mass):
    """Returns a link without a DH frame, which a dependent joint rotates about y."""
    return (
        f'<link name="{name}"><inertial><pose>{centre_of_mass} 0 0 0 0 0</pose><mass>2</mass><inertia><ixx>0.1</ixx>'
        f'<iyy>0.1</iyy><izz>0.1</izz></inertia></inertial></link><joint name="{name}_joint" type="revolute"><parent>'
        f"{parent}</parent><child>{name}</child><axis><xyz>0 1 0</xyz></axis>"
        '<drake:mimic joint="lift" multiplier="2" offset="0"/></joint>'
    )


@pytest.fixture(scope="module", params=["mtmr", "psm", "mtmr tilted", "ur"])
def each_arm(request, ur_like):
    name, _, tilted = request.param.partition(" ")
    each_arm = ur_like if name == "ur" else load_arm(name)
    return each_arm.with_gravity([0.1, -0.5, -9.79]) if tilted else each_arm


def test_base_parameters_equal_the_symbolic_derivation(each_arm):
    """The test uses all standard parameters. `derive_gravity` uses only the columns of the base set."""
    parameters, plant = gravity_parameters(each_arm), SymbolicPlant(each_arm)
    energies = [plant.potential_energy(p.label, p.axis) for p in parameters.standard_parameters]
    columns = [[sympy.diff(e, q) for e in energies] for q in plant.q]
    regressor = sympy.lambdify(plant.q, columns, "numpy", cse=True)
    poses = np.random.default_rng(4).uniform(-2, 2, (80, each_arm.num_joints))
    base = reduce_to_base(
        np.concatenate([np.array(regressor(*q), dtype=float) for q in poses]),
        parameters.standard_parameters,
        numeric.preference_order(parameters.standard_parameters),
        numeric.named_lengths(each_arm, plant.bodies),
    )
    assert base.names == parameters.base.names
    assert base.columns == parameters.base.columns
    np.testing.assert_allclose(base.combination, parameters.base.combination, rtol=0, atol=1e-9)


def test_combination_gives_the_gravity_torque_of_random_links(each_arm):
    """Random links have the gravity torque of the full dynamics. The rotors remain balanced."""
    regressor, parameters = DynamicRegressor(each_arm), gravity_parameters(each_arm)
    links = [link.link for link in regressor.links]
    q = np.random.default_rng(5).uniform(-1, 1, (40, each_arm.num_joints))
    Y = regressor.regressor(q, np.zeros_like(q), np.zeros_like(q))[..., : 10 * len(links)]
    phi = np.concatenate([link.parameters for link in regressor.links])
    framed = np.repeat([not link.startswith("motor_") for link in links], 10)
    phi += np.where(framed, np.random.default_rng(6).normal(size=len(phi)), 0.0)
    lift = np.linalg.lstsq(parameters.combination_of(links), parameters.combination_of(links) @ phi, rcond=None)[0]
    np.testing.assert_allclose(Y @ (phi - lift)[:, None], 0, atol=1e-9)


def test_columns_are_combinations_of_independent_columns():
    generator = np.random.default_rng(7)
    Y = generator.normal(size=(60, 5)) @ generator.normal(size=(5, 11))
    Y[:, 3] = 0.0
    columns, B = independent_columns(Y)
    assert len(columns) == 5 and 3 not in columns and list(columns) == sorted(columns)
    np.testing.assert_allclose(Y[:, columns] @ B, Y, atol=1e-10)
    np.testing.assert_allclose(B[:, columns], np.eye(5), atol=1e-12)


def test_link_with_several_frames_is_counted_once(tmp_path):
    frames = "".join(f'<frame name="dh_{label}" attached_to="wrist_3_link"/>' for label in ("7", "tool"))
    each_arm = load_ur_like(tmp_path, frames)
    q = each_arm.sample_poses(20, np.random.default_rng(1))
    tau = IdentifiedModel.from_arm(each_arm).holding_torque(q)
    np.testing.assert_allclose(tau, holding_torques(each_arm, q), rtol=0, atol=1e-12 * np.abs(tau).max())


@pytest.mark.parametrize(
    ("links", "labels"),
    [
        (moving_link("rotor", "pan_link", 0), set()),
        (moving_link("rotor", "pan_link", 0) + moving_link("cover", "rotor", 0), {"rotor"}),
        (moving_link("lever", "base_link", 0.1), {"lever"}),
    ],
)
def test_links_without_frames(links, labels, tmp_path):
    """A rotor that carries a link is a link itself. All have the gravity torque of Drake's plant."""
    each_arm = load_ur_like(tmp_path, links)
    assert {p.label for p in gravity_parameters(each_arm).standard_parameters if not p.label.isdigit()} == labels
    q = each_arm.sample_poses(20, np.random.default_rng(1))
    tau = IdentifiedModel.from_arm(each_arm).holding_torque(q)
    np.testing.assert_allclose(tau, holding_torques(each_arm, q), rtol=0, atol=1e-12 * np.abs(tau).max())


def test_arm_without_dh_frames_has_a_gravity_model(tmp_path):
    each_arm = load_ur_like(tmp_path)
    text = (tmp_path / "arm.sdf").read_text()
    (tmp_path / "arm.sdf").write_text(re.sub("<frame.*?/>", "", text))
    plain = load_arm(tmp_path / "arm.yaml")
    parameters = gravity_parameters(plain)
    assert parameters.base.names[0] == "L_lift (m_elbow+m_wrist_1+m_wrist_2+m_wrist_3) + m_lift c_lift_x"
    assert len(parameters.base.names) == len(gravity_parameters(each_arm).base.names)
    q = each_arm.sample_poses(20, np.random.default_rng(1))
    tau = IdentifiedModel.from_arm(plain).holding_torque(q)
    np.testing.assert_allclose(tau, holding_torques(each_arm, q), rtol=0, atol=1e-12 * np.abs(tau).max())


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
