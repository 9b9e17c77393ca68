"""Compares the computing times of simulations of a PSM or an ECM: with closed loops, and as an open tree.

    python benchmarks/psm_simulation.py [--arm psm] [--json FILE] [--repetitions N] [--seconds S]

In all controlled rows a GravityPidController at 1 kHz moves all joints along the same smooth motion. Times are CPU
times of this process. The repetitions of the rows alternate, and ratios are medians over the repetitions.

Rows:
    open         Reference without constraints: the joints in series. There is no linkage and no counterweight, the
                 end link is hinged on the yaw link at the remote centre, and both fingers are one body. The gravity
                 model of the controller is that of the arm with the linkage.
    ball         ArmStation with both loops closed by ball constraints; SAP with a time step of 1 ms.
    mimic        ArmStation as a tree with coupled joints; SAP with a time step of 1 ms.
    cenic_mimic  Continuous plant with coupled joints and Drake's error-controlled integrator CENIC, accuracy 1e-4.
                 The samples of the controller limit the integration steps to 1 ms.
    cenic_ball   As cenic_mimic, but with ball constraints.
    fixed_mimic  Row cenic_mimic with fixed steps of 1 ms, without error control.
    fixed_ball   Row cenic_ball with fixed steps of 1 ms, without error control.
    free_mimic   CENIC with coupled joints and without controller, while the arm falls. The row shows the step size
                 that CENIC selects.

Columns:
    closure        largest distance between the two frames of a loop closure, at 50 times of the motion
    remote centre  largest distance of the end link's remote centre from its nominal position, at the same times

The script omits rows that the installed version of Drake cannot run, and prints the reason. CENIC supports ball
constraints since Drake 1.56.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import xml.etree.ElementTree as ElementTree
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from timing import measured_times, median_ratio, print_table, write_json

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import LinearMap
from dvrk_drake.models.plant import add_arm, set_arm_positions
from dvrk_drake.models.sdf_elements import DRAKE
from dvrk_drake.models.sdf_model import compose_sdf
from dvrk_drake.systems.arm_drive import add_arm_drive
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.gravity_pid_controller import GravityPidController


def motion(arm: Arm, seconds: float, share: float) -> PiecewisePolynomial:
    """Returns a motion between two opposite poses of the joint box, with 0.5 s per direction."""
    center, half = (arm.position_lower + arm.position_upper) / 2, (arm.position_upper - arm.position_lower) / 2
    times = np.arange(0.0, seconds + 0.6, 0.5)
    knots = [center + share * (-1) ** i * half for i in range(len(times))]
    return PiecewisePolynomial.CubicHermite(times, np.array(knots).T, np.zeros((arm.num_joints, len(times))))


def open_arm(arm: Arm, folder: Path) -> Arm:
    """Returns the arm without linkage; writes its SDF into `folder`."""
    root = compose_sdf(arm.sdf)
    model = root.find("model")
    joints = {joint.get("name"): joint for joint in model.findall("joint")}
    (center,) = (frame for frame in model.findall("frame") if frame.get("name") == "remote_center")
    joints["pitch"].find("child").text = "end_link"
    ElementTree.SubElement(joints["pitch"], "pose").text = center.findtext("pose")
    if "finger_1" in joints:
        joints["finger_1"].set("type", "fixed")
        joints["finger_1"].remove(joints["finger_1"].find("axis"))
        joints["finger_1"].remove(joints["finger_1"].find(f"{DRAKE}mimic"))
    kept = {"base_link"}
    for _ in joints:  # links that the remaining joints carry
        serial = [joints[name] for name in (*arm.joint_names, "finger_1") if name in joints]
        kept |= {joint.findtext("child") for joint in serial if joint.findtext("parent") in kept}
    for element in list(model):
        moved = element.findtext("child") if element.tag == "joint" else element.get("attached_to", element.get("name"))
        linkage = element.tag == "joint" and element.get("name") not in (*arm.joint_names, "finger_1")
        if element.tag in ("link", "joint", "frame") and (moved not in kept or linkage):
            model.remove(element)
    for group in model.findall(f"{DRAKE}collision_filter_group"):
        for member in group.findall(f"{DRAKE}member"):
            if member.text not in kept:
                group.remove(member)
    path = folder / "open.sdf"
    ElementTree.ElementTree(root).write(path)
    return dataclasses.replace(
        arm,
        sdf=(str(path),),
        tree_joint_names=arm.joint_names,
        linkage=LinearMap(np.eye(arm.num_joints), np.zeros(arm.num_joints)),
        loop_closures=(),
    )


class StationRow:
    """ArmStation with a controller."""

    def __init__(self, arm: Arm, trajectory: PiecewisePolynomial, plant_arm: Arm, closure: str):
        self.arm = arm
        builder = DiagramBuilder()
        self.station = builder.AddSystem(ArmStation(arm, plant_arm=plant_arm, closure=closure))
        self.plant = self.station.plant
        name = arm.name.lower()
        state, command = self.station.GetOutputPort(f"{name}.state_estimated"), f"{name}.effort_commanded"
        add_control(builder, arm, trajectory, state, self.station.GetInputPort(command))
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)

    def set_start(self, root: Context, q: np.ndarray) -> None:
        """Sets the arm to the pose q (n,) with zero velocities."""
        self.station.SetPositions(self.station.GetMyMutableContextFromRoot(root), q)

    def get_positions(self, root: Context) -> np.ndarray:
        """Returns the positions (n,) of the independent joints."""
        return self.station.GetPositions(self.station.GetMyContextFromRoot(root))


class CenicRow:
    """Continuous plant with CENIC, with or without a controller."""

    def __init__(
        self,
        arm: Arm,
        trajectory: PiecewisePolynomial,
        closure: str,
        controlled: bool = True,
        fixed_step: bool = False,
    ):
        self.arm = arm
        builder = DiagramBuilder()
        self.plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        instance = add_arm(self.plant, arm, closure=closure)
        self.plant.Finalize()
        drive = add_arm_drive(builder, self.plant, arm, instance)
        if controlled:
            add_control(builder, arm, trajectory, drive.state_estimated, drive.effort_commanded)
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        ResetIntegratorFromFlags(self.simulator, "cenic", 0.1)
        integrator = self.simulator.get_mutable_integrator()
        integrator.set_target_accuracy(1e-4)
        if fixed_step:
            integrator.set_maximum_step_size(1e-3)
            integrator.set_fixed_step_mode(True)

    def set_start(self, root: Context, q: np.ndarray) -> None:
        """Sets the arm to the pose q (n,) with zero velocities."""
        set_arm_positions(self.plant, self.plant.GetMyMutableContextFromRoot(root), self.arm, q)

    def get_positions(self, root: Context) -> np.ndarray:
        """Returns the positions (n,) of the independent joints."""
        context = self.plant.GetMyContextFromRoot(root)
        return np.array([self.plant.GetJointByName(name).GetOnePosition(context) for name in self.arm.joint_names])


def add_control(builder: DiagramBuilder, arm: Arm, trajectory: PiecewisePolynomial, state, command) -> None:
    controller = builder.AddSystem(GravityPidController(IdentifiedModel.from_arm(arm)))
    desired = builder.AddSystem(TrajectorySource(trajectory, output_derivative_order=1))
    builder.Connect(state, controller.GetInputPort("state_estimated"))
    builder.Connect(desired.get_output_port(), controller.GetInputPort("desired_state"))
    builder.Connect(controller.GetOutputPort("effort"), command)


def restart(row: StationRow | CenicRow, q: np.ndarray) -> None:
    """Sets the arm to the pose q with zero velocities, and the time to 0."""
    root = row.simulator.get_mutable_context()
    root.SetTime(0.0)
    row.diagram.SetDefaultContext(root)
    row.set_start(root, q)
    row.simulator.Initialize()


def steps_per_second(row: StationRow | CenicRow, start: np.ndarray, seconds: float) -> int:
    """Simulates the motion and returns the number of solver steps per simulated second."""
    restart(row, start)
    before = row.simulator.get_integrator().get_num_steps_taken()
    row.simulator.AdvanceTo(seconds)
    plant: MultibodyPlant = row.plant
    taken = row.simulator.get_integrator().get_num_steps_taken() - before
    return round(1 / plant.time_step() if plant.time_step() else taken / seconds)


def closure_errors(row: StationRow | CenicRow, seconds: float) -> tuple[float, float]:
    """Returns the largest distances between loop closure frames, and of the remote centre from the origin [m]."""
    plant, root = row.plant, row.simulator.get_context()
    pins, centre = 0.0, 0.0
    for time in np.linspace(0.0, seconds, 51)[1:]:
        row.simulator.AdvanceTo(time)
        context = plant.GetMyContextFromRoot(root)

        def place(frame: str, context: Context = context) -> np.ndarray:
            return plant.GetFrameByName(frame).CalcPoseInWorld(context).translation()

        for loop in row.arm.loop_closures:
            pins = max(pins, float(np.linalg.norm(place(loop.frame_a) - place(loop.frame_b))))
        centre = max(centre, float(np.linalg.norm(place("remote_center"))))
    return pins, centre


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", default="psm", help="psm, psm_si, ecm or ecm_si; default: %(default)s")
    parser.add_argument("--share", type=float, default=0.2, help="amplitude / range of a joint; default: %(default)s")
    parser.add_argument("--json", metavar="FILE", help="write the results to this file")
    parser.add_argument("--repetitions", type=int, default=11, help="number of repetitions; default: %(default)s")
    parser.add_argument("--seconds", type=float, default=1.0, help="simulated time of one repetition [s]")
    arguments = parser.parse_args()
    arm = load_arm(arguments.arm)
    trajectory = motion(arm, arguments.seconds, arguments.share)
    start, end = (trajectory.value(time)[:, 0] for time in (0.0, arguments.seconds))
    rows: dict[str, StationRow | CenicRow] = {}
    omitted: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        makers = {
            "open": lambda: StationRow(arm, trajectory, open_arm(arm, Path(folder)), "mimic"),
            "ball": lambda: StationRow(arm, trajectory, arm, "ball"),
            "mimic": lambda: StationRow(arm, trajectory, arm, "mimic"),
            "cenic_mimic": lambda: CenicRow(arm, trajectory, "mimic"),
            "cenic_ball": lambda: CenicRow(arm, trajectory, "ball"),
            "fixed_mimic": lambda: CenicRow(arm, trajectory, "mimic", fixed_step=True),
            "fixed_ball": lambda: CenicRow(arm, trajectory, "ball", fixed_step=True),
            "free_mimic": lambda: CenicRow(arm, trajectory, "mimic", controlled=False),
        }
        for name, make in makers.items():
            try:
                row = make()
                restart(row, start)
                row.simulator.AdvanceTo(1e-3)
                rows[name] = row
            except RuntimeError as error:
                omitted[name] = str(error).splitlines()[0][:120]

    errors, steps = {}, {}
    for name, row in rows.items():
        steps[name] = steps_per_second(row, start, arguments.seconds)
        if name not in ("open", "free_mimic"):
            off = np.abs(row.get_positions(row.simulator.get_context()) - end)
            assert np.all(off < arm.per_joint(0.02, 0.002)), f"Row {name} did not reach the end pose; errors: {off}"
            restart(row, start)
            errors[name] = closure_errors(row, arguments.seconds)
    for name in ("ball", "mimic"):
        assert max(errors[name]) < 5e-8, f"Row {name}: the closure errors are too large: {errors[name]} m"

    times = measured_times(
        {name: partial(row.simulator.AdvanceTo, arguments.seconds) for name, row in rows.items()},
        arguments.repetitions,
        prepare=lambda name: restart(rows[name], start),
    )
    us = {name: 1e3 * float(np.median(values)) / arguments.seconds for name, values in times.items()}
    ratio = {name: median_ratio(times, name, "open") for name in rows}
    print_table(
        f"{arguments.arm}, drake {version('drake')}: CPU time per simulated ms, median of {arguments.repetitions} runs",
        ["time [us]", "real-time factor", "ratio to open", "steps per s", "closure [m]", "remote centre [m]"],
        {
            name: (
                f"{us[name]:.1f}",
                f"{1e3 / us[name]:.1f}",
                f"{ratio[name]:.2f}",
                steps[name],
                *(f"{error:.1e}" for error in errors.get(name, ())),
                *([] if name in errors else ["-", "-"]),
            )
            for name in rows
        },
    )
    for name, reason in omitted.items():
        print(f"  {name} omitted: {reason}")
    result = {
        "drake": version("drake"),
        "us_per_simulated_ms": us,
        "time_ratio_to_open": ratio,
        "steps": steps,
        "closure_errors": errors,
    }
    write_json(arguments.json, result)


if __name__ == "__main__":
    main()
