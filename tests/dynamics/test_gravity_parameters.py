"""Compares numeric base parameters of gravity with base parameters from symbolic potential energies."""

import re

import numpy as np
import pytest
import sympy

from dvrk_drake.dynamics import gravity_parameters as numeric
from dvrk_drake.dynamics.base_parameters import independent_columns, reduce_to_base
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.gravity_parameters import gravity_parameters
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.symbolic_gravity import SymbolicPlant
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import holding_torques

pytestmark = [pytest.mark.numeric, pytest.mark.drake_api]

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
def arm(request, ur_like):
    name, _, tilted = request.param.partition(" ")
    arm = ur_like if name == "ur" else load_arm(name)
    return arm.with_gravity([0.1, -0.5, -9.79]) if tilted else arm


def test_base_parameters_equal_the_symbolic_derivation(arm):
    """The test uses all standard parameters. `derive_gravity` uses only the columns of the base set."""
    parameters, plant = gravity_parameters(arm), SymbolicPlant(arm)
    energies = [plant.potential_energy(p.label, p.axis) for p in parameters.standard_parameters]
    columns = [[sympy.diff(e, q) for e in energies] for q in plant.q]
    regressor = sympy.lambdify(plant.q, columns, "numpy", cse=True)
    poses = np.random.default_rng(4).uniform(-2, 2, (80, arm.num_joints))
    base = reduce_to_base(
        np.concatenate([np.array(regressor(*q), dtype=float) for q in poses]),
        parameters.standard_parameters,
        numeric.preference_order(parameters.standard_parameters),
        numeric.named_lengths(arm, plant.bodies),
    )
    assert base.names == parameters.base.names
    assert base.columns == parameters.base.columns
    np.testing.assert_allclose(base.combination, parameters.base.combination, rtol=0, atol=1e-9)


def test_combination_gives_the_gravity_torque_of_random_links(arm):
    """Random links have the gravity torque of the full dynamics. The rotors remain balanced."""
    regressor, parameters = DynamicRegressor(arm), gravity_parameters(arm)
    links = [link.link for link in regressor.links]
    q = np.random.default_rng(5).uniform(-1, 1, (40, arm.num_joints))
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
    arm = load_ur_like(tmp_path, frames)
    q = arm.sample_poses(20, np.random.default_rng(1))
    tau = IdentifiedModel.from_arm(arm).holding_torque(q)
    np.testing.assert_allclose(tau, holding_torques(arm, q), rtol=0, atol=1e-12 * np.abs(tau).max())


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
    arm = load_ur_like(tmp_path, links)
    assert {p.label for p in gravity_parameters(arm).standard_parameters if not p.label.isdigit()} == labels
    q = arm.sample_poses(20, np.random.default_rng(1))
    tau = IdentifiedModel.from_arm(arm).holding_torque(q)
    np.testing.assert_allclose(tau, holding_torques(arm, q), rtol=0, atol=1e-12 * np.abs(tau).max())


def test_arm_without_dh_frames_has_a_gravity_model(tmp_path):
    arm = load_ur_like(tmp_path)
    text = (tmp_path / "arm.sdf").read_text()
    (tmp_path / "arm.sdf").write_text(re.sub("<frame.*?/>", "", text))
    plain = load_arm(tmp_path / "arm.yaml")
    parameters = gravity_parameters(plain)
    assert parameters.base.names[0] == "L_lift (m_elbow+m_wrist_1+m_wrist_2+m_wrist_3) + m_lift c_lift_x"
    assert len(parameters.base.names) == len(gravity_parameters(arm).base.names)
    q = arm.sample_poses(20, np.random.default_rng(1))
    tau = IdentifiedModel.from_arm(plain).holding_torque(q)
    np.testing.assert_allclose(tau, holding_torques(arm, q), rtol=0, atol=1e-12 * np.abs(tau).max())
