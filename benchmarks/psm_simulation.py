"""How much faster than real time the PSM is simulated under control, with its loops closed and without.

    python benchmarks/psm_simulation.py [--json FILE] [--repetitions N] [--seconds S]

All rows are the same arm under GravityPidController at 1 kHz, which moves all joints along one smooth motion; nothing
is published and it runs as fast as it can. Repetitions are interleaved, so that a busy machine slows
all rows alike. The real-time factor is simulated time over CPU time of this process (one thread: on a core of its own
that is wall time), median over the repetitions.

Rows:
    ball         ArmStation with both loops pinned; SAP at 1 ms.
    mimic        The same station as a tree whose joints are coupled.
    open         The seven joints alone, without any constraint: end link hinged on the yaw link at the remote centre,
                 no linkage and counterweight, fingers as one; the controller's gravity is not its.
    cenic_mimic  A continuous plant with couplings under Drake's error-controlled CENIC, accuracy 1e-4; the controller's
    cenic_ball   samples bound its steps, so that none is longer than 1 ms. The second has its loops pinned.
    free_mimic   CENIC with couplings and no controller: the arm falls, and CENIC chooses its steps. For its steps only.

Rows that this version of drake cannot run are left out, with its reason: CENIC knows pins from 1.56 on. Ends with exit
code 1 if `ball` is slower than it must be.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from importlib.metadata import version
from pathlib import Path

import numpy as np
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import MatrixGain, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.linear_map import LinearMap
from dvrk_drake.models.plant import add_arm, set_arm_positions
from dvrk_drake.models.sdf_model import DRAKE, compose_sdf
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

ARM = load_arm("psm")
N = ARM.num_joints
LEAST_FACTOR = 8.0


def motion(seconds: float) -> PiecewisePolynomial:
    """Between two opposite poses of the box, half a second each way."""
    center, half = (ARM.position_lower + ARM.position_upper) / 2, (ARM.position_upper - ARM.position_lower) / 2
    times = np.arange(0.0, seconds + 0.6, 0.5)
    knots = [center + 0.2 * (-1) ** i * half for i in range(len(times))]
    return PiecewisePolynomial.CubicHermite(times, np.array(knots).T, np.zeros((N, len(times))))


def open_arm(folder: Path) -> Arm:
    """The PSM without linkage, as a file of its own in `folder`."""
    root = compose_sdf(ARM.sdf, ARM.mirrored_links)
    model = root.find("model")
    joints = {joint.get("name"): joint for joint in model.findall("joint")}
    joints["pitch"].find("child").text = "end_link"
    ElementTree.SubElement(joints["pitch"], "pose").text = "0 0.042998 -0.143705 0 0 0"
    joints["finger_1"].set("type", "fixed")
    joints["finger_1"].remove(joints["finger_1"].find("axis"))
    joints["finger_1"].remove(joints["finger_1"].find(f"{DRAKE}mimic"))
    linkage = ("bottom_bar", "top_bar", "front_crank", "end", "counterweight")
    gone = {f"{name}_link" for name in (*linkage, "back_crank")} - {"end_link"}
    for element in list(model):
        if element.get("name") in {*linkage, *gone} or element.get("attached_to") in gone:
            model.remove(element)
    for group in model.findall(f"{DRAKE}collision_filter_group"):
        for member in group.findall(f"{DRAKE}member"):
            if member.text in gone:
                group.remove(member)
    path = folder / "open.sdf"
    ElementTree.ElementTree(root).write(path)
    return dataclasses.replace(
        ARM,
        sdf=(str(path),),
        tree_joint_names=ARM.joint_names,
        linkage=LinearMap(np.eye(N), np.zeros(N)),
        loop_closures=(),
    )


class StationRow:
    """A station under control."""

    def __init__(self, trajectory: PiecewisePolynomial, plant_arm: Arm, closure: str):
        builder = DiagramBuilder()
        self.station = builder.AddSystem(ArmStation(ARM, plant_arm=plant_arm, closure=closure))
        self.plant = self.station.plant
        state, command = self.station.GetOutputPort("psm.state_estimated"), "psm.effort_commanded"
        add_control(builder, trajectory, state, self.station.GetInputPort(command))
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)

    def set_start(self, root: Context, q: np.ndarray) -> None:
        """Puts the arm at q, at rest."""
        self.station.SetPositions(self.station.GetMyMutableContextFromRoot(root), q)

    def get_positions(self, root: Context) -> np.ndarray:
        """Pose of the seven joints."""
        return self.station.GetPositions(self.station.GetMyContextFromRoot(root))


class CenicRow:
    """A continuous plant under control, or without it, with CENIC."""

    def __init__(self, trajectory: PiecewisePolynomial, closure: str, controlled: bool):
        builder = DiagramBuilder()
        self.plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        add_arm(self.plant, ARM, closure)
        self.plant.Finalize()
        nq = self.plant.num_positions()
        select = np.zeros((nq, N))
        select[[self.plant.GetJointByName(name).position_start() for name in ARM.joint_names], range(N)] = 1.0
        state = builder.AddSystem(MatrixGain(D=np.kron(np.eye(2), select.T)))
        driven = [self.plant.get_joint_actuator(i).joint().name() for i in self.plant.GetJointActuatorIndices()]
        actuate = builder.AddSystem(MatrixGain(D=np.eye(N)[[ARM.joint_names.index(name) for name in driven]]))
        builder.Connect(self.plant.get_state_output_port(), state.get_input_port())
        builder.Connect(actuate.get_output_port(), self.plant.get_actuation_input_port())
        if controlled:
            add_control(builder, trajectory, state.get_output_port(), actuate.get_input_port())
        else:
            builder.ExportInput(actuate.get_input_port(), "effort")
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        if not controlled:
            self.diagram.GetInputPort("effort").FixValue(self.simulator.get_mutable_context(), np.zeros(N))
        ResetIntegratorFromFlags(self.simulator, "cenic", 0.1)
        self.simulator.get_mutable_integrator().set_target_accuracy(1e-4)

    def set_start(self, root: Context, q: np.ndarray) -> None:
        """Puts the arm at q, at rest."""
        set_arm_positions(self.plant, self.plant.GetMyMutableContextFromRoot(root), ARM, q)

    def get_positions(self, root: Context) -> np.ndarray:
        """Pose of the seven joints."""
        context = self.plant.GetMyContextFromRoot(root)
        return np.array([self.plant.GetJointByName(name).GetOnePosition(context) for name in ARM.joint_names])


def add_control(builder: DiagramBuilder, trajectory: PiecewisePolynomial, state, command) -> None:
    controller = builder.AddSystem(GravityPidController(IdentifiedModel.from_arm(ARM)))
    desired = builder.AddSystem(TrajectorySource(trajectory, output_derivative_order=1))
    builder.Connect(state, controller.GetInputPort("state_estimated"))
    builder.Connect(desired.get_output_port(), controller.GetInputPort("desired_state"))
    builder.Connect(controller.GetOutputPort("effort"), command)


def measure(row: StationRow | CenicRow, q: np.ndarray, seconds: float) -> tuple[float, int]:
    """CPU seconds and number of solver steps per simulated second."""
    root = row.simulator.get_mutable_context()
    root.SetTime(0.0)
    diagram: Diagram = row.diagram
    diagram.SetDefaultContext(root)
    row.set_start(root, q)
    row.simulator.Initialize()
    integrator = row.simulator.get_integrator()
    integrator_steps = integrator.get_num_steps_taken()
    before = time.process_time()
    row.simulator.AdvanceTo(seconds)
    duration = time.process_time() - before
    plant: MultibodyPlant = row.plant
    steps = (
        seconds / plant.time_step() if plant.time_step() > 0 else integrator.get_num_steps_taken() - integrator_steps
    )
    return duration / seconds, round(steps / seconds)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", metavar="FILE", help="write the numbers there too")
    parser.add_argument("--repetitions", type=int, default=11)
    parser.add_argument("--seconds", type=float, default=1.0, help="simulated time of one repetition")
    arguments = parser.parse_args()
    trajectory = motion(arguments.seconds)
    with tempfile.TemporaryDirectory() as folder:
        makers = {
            "ball": lambda: StationRow(trajectory, ARM, "ball"),
            "mimic": lambda: StationRow(trajectory, ARM, "mimic"),
            "open": lambda: StationRow(trajectory, open_arm(Path(folder)), "mimic"),
            "cenic_mimic": lambda: CenicRow(trajectory, "mimic", True),
            "cenic_ball": lambda: CenicRow(trajectory, "ball", True),
            "free_mimic": lambda: CenicRow(trajectory, "mimic", False),
        }
        rows, left_out = {}, {}
        for name, make in makers.items():
            try:
                rows[name] = make()
                measure(rows[name], trajectory.value(0.0)[:, 0], arguments.seconds)  # also warms caches
            except RuntimeError as error:
                rows.pop(name, None)
                left_out[name] = str(error).splitlines()[0][:120]

    cost: dict[str, list[float]] = {name: [] for name in rows}
    steps = {}
    for _ in range(arguments.repetitions):
        for name, row in rows.items():
            seconds, steps[name] = measure(row, trajectory.value(0.0)[:, 0], arguments.seconds)
            cost[name].append(seconds)
    for name in ("ball", "mimic", "cenic_mimic", "cenic_ball"):
        if name in rows:
            q = rows[name].get_positions(rows[name].simulator.get_context())
            error = np.abs(q - trajectory.value(arguments.seconds)[:, 0])
            assert np.all(error < ARM.per_joint(0.02, 0.002)), f"{name} is not where it should be: {error}"

    factor = {name: float(1 / np.median(values)) for name, values in cost.items()}
    ratio = {name: float(np.median(np.divide(cost[name], cost["mimic"]))) for name in cost}
    print(f"drake {version('drake')}; PSM at 1 kHz, median of {arguments.repetitions}")
    print("  row          real-time factor   time / mimic   solver steps / s")
    for name in rows:
        print(f"  {name:12} {factor[name]:10.1f} {ratio[name]:18.2f} {steps[name]:16d}")
    for name, reason in left_out.items():
        print(f"  {name:12} left out: {reason}")
    print(f"  ball is {'at least' if factor['ball'] >= LEAST_FACTOR else 'BELOW'} {LEAST_FACTOR:g} times real time")
    if arguments.json:
        with open(arguments.json, "w", encoding="utf-8") as stream:
            result = {
                "drake": version("drake"),
                "real_time_factor": factor,
                "time_ratio_to_mimic": ratio,
                "steps": steps,
            }
            json.dump(result, stream, indent=2)
            stream.write("\n")
    return int(factor["ball"] < LEAST_FACTOR)


if __name__ == "__main__":
    sys.exit(main())
