"""Model files of robots that are not arms of this package, and recordings of these robots."""

from pathlib import Path

import numpy as np

from dvrk_drake.models.plant import inverse_dynamics
from dvrk_drake.recordings.recording import Recording

#: Rotor inertias [kg m^2, kg] that the model file does not state, and Coulomb friction [N m, N].
ROTORS, FRICTION = np.array([0.8, 5.0, 0.05]), np.array([1.5, 3.0, 0.4])
#: Middle and size of the motion of each joint [rad, m].
MIDDLE, SIZE = np.array([0.0, 0.15, 0.2]), np.array([0.25, 0.025, 0.18])
#: Arm with four moving joints: a turning column, a carriage on it, and two links of which the second mimics the first.
#: The column has two bodies, and the base is fixed to the world by a turned joint.
URDF = """<robot name="crane">
  <link name="world"/>
  <link name="floor">
    <inertial><mass value="9"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="anchor" type="fixed">
    <parent link="world"/><child link="floor"/><origin xyz="0.1 0.2 0.3" rpy="0.3 0.2 0.1"/>
  </joint>
  <link name="column">
    <inertial><origin xyz="0.02 0.01 0.2"/><mass value="3"/>
      <inertia ixx="0.05" iyy="0.06" izz="0.02" ixy="0.001" ixz="0.002" iyz="0.003"/></inertial>
    <collision><origin xyz="0 0 0.2"/><geometry><box size="0.1 0.1 0.4"/></geometry></collision>
  </link>
  <joint name="turn" type="continuous">
    <parent link="floor"/><child link="column"/><axis xyz="0 0 1"/><limit effort="80" velocity="3"/>
    <dynamics damping="0.5"/>
  </joint>
  <link name="motor_box">
    <inertial><origin xyz="0 0.05 0"/><mass value="1.5"/>
      <inertia ixx="0.004" iyy="0.003" izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://crane_description/meshes/no_such_file.obj"/></geometry></visual>
  </link>
  <joint name="mount" type="fixed">
    <parent link="column"/><child link="motor_box"/><origin xyz="0.1 0 0.1" rpy="0 0 1.2"/>
  </joint>
  <link name="carriage">
    <inertial><origin xyz="0.1 0 0"/><mass value="2"/>
      <inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="lift" type="prismatic">
    <parent link="column"/><child link="carriage"/><origin xyz="0 0.03 0.4" rpy="0 0.4 0"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="0.3" effort="120" velocity="1"/>
  </joint>
  <link name="arm">
    <inertial><origin xyz="0.2 0.01 0"/><mass value="1.2"/>
      <inertia ixx="0.002" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="swing" type="revolute">
    <parent link="carriage"/><child link="arm"/><origin xyz="0.2 0 0" rpy="1.5 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-1.5" upper="2" effort="20" velocity="4"/>
  </joint>
  <link name="hand">
    <inertial><origin xyz="0.05 0 0.02"/><mass value="0.4"/>
      <inertia ixx="0.0004" iyy="0.0008" izz="0.0007" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="level" type="revolute">
    <parent link="arm"/><child link="hand"/><origin xyz="0.4 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="10" velocity="4"/><mimic joint="swing" multiplier="-0.8" offset="0.1"/>
  </joint>
  <link name="tip"/>
  <joint name="tip_joint" type="fixed"><parent link="hand"/><child link="tip"/><origin xyz="0.1 0 0"/></joint>
</robot>
"""


def random_robot(folder: Path, seed: int, size: float = 1.0) -> Path:
    """Writes the model file of a random arm with four joints and returns its path.

    One joint is prismatic, and the last joint mimics a revolute one. The first joint is continuous. An arm with another
    size has geometrically similar links of the same density. Motors can hold the arm in every pose.
    """
    generator = np.random.default_rng(seed)
    joints = ["continuous", *generator.permutation(["prismatic", "revolute"]), "mimic"]
    masses, text = size**3 * generator.uniform(0.2, 1.0, 4), '<robot name="random"><link name="link_0"/>'
    force = 3 * 9.81 * masses.sum()

    def vector(length: float) -> str:
        return " ".join(map(str, length * generator.uniform(-1, 1, 3)))

    for i, (kind, mass) in enumerate(zip(joints, masses, strict=True), 1):
        x, y, z = (size * generator.uniform(0.1, 0.3, 3)) ** 2
        moments = {"ixx": y + z, "iyy": x + z, "izz": x + y, "ixy": 0, "ixz": 0, "iyz": 0}
        inertia = " ".join(f'{name}="{mass / 12 * moment}"' for name, moment in moments.items())
        reach, effort = (0.4 * size, force) if kind == "prismatic" else (2.0, force * size)
        mimic = f'<mimic joint="joint_{1 + joints.index("revolute")}" multiplier="-0.7" offset="0.2"/>'
        text += f"""
          <link name="link_{i}"><inertial><origin xyz="{vector(0.15 * size)}"/><mass value="{mass}"/>
            <inertia {inertia}/></inertial></link>
          <joint name="joint_{i}" type="{"revolute" if kind == "mimic" else kind}">
            <parent link="link_{i - 1}"/><child link="link_{i}"/>
            <origin xyz="{vector(0.3 * size)}" rpy="{vector(1.5)}"/><axis xyz="{vector(1.0)}"/>
            <limit lower="{-reach}" upper="{reach}" effort="{effort}" velocity="3"/>
            {mimic if kind == "mimic" else ""}
          </joint>"""
    path = folder / "random.urdf"
    path.write_text(text + "</robot>")
    return path


def write_robot(folder: Path, *changes: tuple[str, str], name: str = "crane.urdf", text: str = URDF) -> Path:
    """Writes the model file, with parts of its text replaced, and returns its path."""
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / name
    path.write_text(text)
    return path


def robot_motion(
    arm,
    seed=0,
    seconds=15.0,
    middle=MIDDLE,
    size=SIZE,
    rotors=ROTORS,
    friction=FRICTION,
    noise=(0.3, 0.5, 0.05),
    inertias=None,
):
    """Recording of a motion at 100 Hz, with rotors, friction and noise, at the mounting of the arm."""
    generator = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.01)
    phases = generator.uniform(0, 2 * np.pi, (5, 3))
    w = 2 * np.pi * np.array([0.1, 0.2, 0.35, 0.5, 0.8])[:, None, None]
    angles = w * t[:, None] + phases[:, None, :]
    q = middle + size * np.sum(np.sin(angles), axis=0)
    v, vd = size * np.sum(w * np.cos(angles), axis=0), -size * np.sum(w**2 * np.sin(angles), axis=0)
    tau = inverse_dynamics(arm, q, v, vd, inertias) + rotors * vd + friction * np.tanh(v / 0.02)
    tau += generator.normal(size=tau.shape) * np.array(noise)
    return Recording(q=q, qd=v, tau=tau, t=t, source=f"motion_{seed}.csv")


def random_motion(arm, seed=0, inertias=None):
    """Recording of a motion of an arm of any size: friction is 2 % of the effort limits, noise 0.2 %, no rotors."""
    size = np.where(arm.prismatic, 0.05 * arm.position_upper, 0.18)
    share = arm.effort_limits
    return robot_motion(
        arm, seed, middle=0.0, size=size, rotors=0.0, friction=0.02 * share, noise=0.002 * share, inertias=inertias
    )
