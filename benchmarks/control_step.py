"""Compares the computing time of GravityPidController with that of Drake's C++ controllers.

    python benchmarks/control_step.py [--json FILE] [--repetitions N] [--seconds S]

All rows simulate the same ArmStation (10 joints, 3 of them coupled) with SAP and a time step of 1 ms. Each repetition
starts from the same pose and steps all joints by 0.1 rad. The repetitions of the rows alternate, so that other
processes slow all rows equally. Times are CPU times of this process per simulated millisecond, medians over the
repetitions.

Rows:
    python      GravityPidController: Python LeafSystem with one compiled update per millisecond.
    cpp         Drake's InverseDynamics (gravity compensation) on a controller plant, PidController, and Adder.
                InverseDynamics ignores couplers. Therefore it uses the whole tree, and a MatrixGain multiplies its
                output by G' (transposed linkage matrix). This row is the reference.
    cpp_serial  As cpp, but on a plant of the seven independent joints and without the MatrixGain. The gravity torque is
                wrong, since the counterweight is on the linkage. The row is a lower bound of the time without a
                linkage.
    none        No control, but the constant effort that balances the start pose.

The column `control` is the time of a row minus the time of row `none`. The integral of PidController is a continuous
state. The cpp rows integrate it with explicit Euler at 1 ms. Unlike the python row, the cpp rows have no delay.
"""

from __future__ import annotations

import argparse
import xml.etree.ElementTree as ElementTree
from functools import partial
from importlib.metadata import version

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.controllers import InverseDynamics, PidController
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, System
from pydrake.systems.primitives import Adder, ConstantVectorSource, MatrixGain
from timing import measured_times, median_ratio, print_table, write_json

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import make_arm_plant, tree_selector
from dvrk_drake.models.sdf_elements import DRAKE
from dvrk_drake.models.sdf_model import compose_sdf
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

START = np.array([0.2, 0.3, -0.1, 0.5, 0.6, 0.1, -0.4])
GOAL = START + 0.1


def serial_plant(arm: Arm) -> MultibodyPlant:
    root = compose_sdf(arm.sdf)
    model = root.find("model")
    names = arm.joint_names
    ElementTree.register_namespace("drake", DRAKE.strip("{}"))
    dependent = [j for j in model.findall("joint") if j.get("name") not in names and j.get("type") != "fixed"]
    gone = {joint.findtext("child") for joint in dependent}
    for element in [*dependent, *model.findall("link"), *model.findall("frame")]:
        if element in dependent or element.get("name") in gone or element.get("attached_to") in gone:
            model.remove(element)
    for group in model.findall(f"{DRAKE}collision_filter_group"):
        model.remove(group)
    plant = MultibodyPlant(1e-3)
    Parser(plant).AddModelsFromString(ElementTree.tostring(root, encoding="unicode"), "sdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base_link"))
    plant.mutable_gravity_field().set_gravity_vector(arm.gravity)
    plant.Finalize()
    return plant


def tree_state_order(station: ArmStation, plant: MultibodyPlant) -> bool:
    """Returns whether the plants of the station and of the controller have their joints in the same order."""
    return np.array_equal(tree_selector(station.plant, station.arm), tree_selector(plant, station.arm))


def build(row: str, arm: Arm) -> tuple[Diagram, ArmStation, System, list[object]]:
    """Returns the diagram, its station, the system that outputs the effort, and objects to keep alive."""
    builder = DiagramBuilder()
    station = builder.AddSystem(ArmStation(arm))
    state = station.GetOutputPort("mtml.state_estimated")
    command = station.GetInputPort("mtml.effort_commanded")
    if row == "none":
        balance = IdentifiedModel.from_arm(arm).holding_torque(START)
        source = builder.AddSystem(ConstantVectorSource(balance))
        builder.Connect(source.get_output_port(), command)
        return builder.Build(), station, source, []
    desired = builder.AddSystem(ConstantVectorSource(np.concatenate([GOAL, np.zeros(arm.num_joints)])))
    if row == "python":
        controller = builder.AddSystem(GravityPidController(IdentifiedModel.from_arm(arm)))
        builder.Connect(state, controller.GetInputPort("state_estimated"))
        builder.Connect(desired.get_output_port(), controller.GetInputPort("desired_state"))
        builder.Connect(controller.GetOutputPort("effort"), command)
        return builder.Build(), station, controller, []
    plant = make_arm_plant(arm) if row == "cpp" else serial_plant(arm)
    gravity_only = InverseDynamics.InverseDynamicsMode.kGravityCompensation
    gravity = builder.AddSystem(InverseDynamics(plant, gravity_only))
    pid = builder.AddSystem(PidController(kp=arm.gains.kp, ki=arm.gains.ki, kd=arm.gains.kd))
    total = builder.AddSystem(Adder(num_inputs=2, size=arm.num_joints))
    if row == "cpp":
        assert tree_state_order(station, plant)
        G = np.zeros((plant.num_positions(), arm.num_joints))
        G[tree_selector(plant, arm)] = arm.linkage.matrix
        project = builder.AddSystem(MatrixGain(D=G.T))
        builder.Connect(station.GetOutputPort("plant_state"), gravity.get_input_port_estimated_state())
        builder.Connect(gravity.get_output_port(), project.get_input_port())
        builder.Connect(project.get_output_port(), total.get_input_port(0))
    else:
        builder.Connect(state, gravity.get_input_port_estimated_state())
        builder.Connect(gravity.get_output_port(), total.get_input_port(0))
    builder.Connect(state, pid.get_input_port_estimated_state())
    builder.Connect(desired.get_output_port(), pid.get_input_port_desired_state())
    builder.Connect(pid.get_output_port(), total.get_input_port(1))
    builder.Connect(total.get_output_port(), command)
    return builder.Build(), station, total, [plant]


def start(row: str, arm: Arm) -> tuple[Simulator, ArmStation, System, list[object]]:
    diagram, station, source, keep = build(row, arm)
    simulator = Simulator(diagram)
    simulator.set_target_realtime_rate(0.0)
    if row.startswith("cpp"):
        ResetIntegratorFromFlags(simulator, "explicit_euler", 1e-3)
    restart(simulator, station)
    return simulator, station, source, keep


def restart(simulator: Simulator, station: ArmStation) -> None:
    context = simulator.get_mutable_context()
    context.SetTime(0.0)
    simulator.get_system().SetDefaultContext(context)
    station.SetPositions(station.GetMyMutableContextFromRoot(context), START)
    simulator.Initialize()


def effort(source: System, context: Context) -> np.ndarray:
    return source.get_output_port(0).Eval(source.GetMyContextFromRoot(context))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", metavar="FILE", help="write the results to this file")
    parser.add_argument("--repetitions", type=int, default=15, help="number of repetitions; default: %(default)s")
    parser.add_argument("--seconds", type=float, default=0.5, help="simulated time of one repetition [s]")
    arguments = parser.parse_args()
    arm = load_arm("mtml")
    rows = {row: start(row, arm) for row in ("python", "cpp", "cpp_serial", "none")}

    # The comparison requires equal efforts. Compare the first efforts, clamped to the limits.
    ours, theirs = (effort(rows[row][2], rows[row][0].get_context()) for row in ("python", "cpp"))
    difference = np.abs(ours - np.clip(theirs, -arm.effort_limits, arm.effort_limits)).max()
    assert difference < 1e-9, f"The efforts of python and cpp differ by {difference:.2g} N m."

    times = measured_times(
        {row: partial(simulator.AdvanceTo, arguments.seconds) for row, (simulator, *_) in rows.items()},
        arguments.repetitions,
        prepare=lambda row: restart(*rows[row][:2]),
    )
    for row in ("python", "cpp"):
        simulator, station = rows[row][:2]
        q = station.GetPositions(station.GetMyContextFromRoot(simulator.get_context()))
        assert np.abs(q - GOAL).max() < 0.02, f"Row {row} did not reach the goal; final positions: {q}"

    median = {row: 1e3 * float(np.median(values)) / arguments.seconds for row, values in times.items()}
    ratio = {row: median_ratio(times, "python", row) for row in rows}
    print_table(
        f"MTML, drake {version('drake')}: CPU time per simulated ms, median of {arguments.repetitions} repetitions",
        ["total [us]", "control [us]", "time of python / time of this row"],
        {row: (f"{us:.1f}", f"{us - median['none']:.1f}", f"{ratio[row]:.3f}") for row, us in median.items()},
    )
    result = {"drake": version("drake"), "us_per_simulated_ms": median, "ratio_python_to": ratio}
    write_json(arguments.json, result)


if __name__ == "__main__":
    main()
