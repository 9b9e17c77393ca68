"""Command that runs a simulated arm over LCM or ROS 2."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from dvrk_drake.cli.app import HARDWARE, ConnectedArm, Gravity, Model, Realtime, app
from dvrk_drake.cli.support import (
    driver_configuration,
    interrupt_ends_process,
    mounted,
    print_line,
    request_realtime,
)


@app.command(group=HARDWARE)
def sim_arm(
    *,
    connected: ConnectedArm,
    pose: Annotated[list[float] | None, Parameter(metavar="Q ..", consume_multiple=True)] = None,
    gravity: Gravity = None,
    effects: Annotated[list[str] | None, Parameter(metavar="NAME ..", consume_multiple=True)] = None,
    realtime: Realtime = False,
    driver: Annotated[str | None, Parameter(metavar="FILE.yaml")] = None,
    rate: Annotated[float | None, Parameter(metavar="HZ")] = None,
    model: Model | None = None,
    enabled: Annotated[bool, Parameter(show_default=False)] = False,
) -> None:
    """Simulate an arm with its driver, over LCM or ROS 2.

    On LCM, the driver has the command guard. On ROS 2, it has the topics of a dVRK.

    Args:
        pose: Initial joint positions [rad; m if prismatic]. Default: near zero, within the joint limits.
        effects: Simulated effects, e.g. friction, or all (docs/simulated_effects.md). Default: none.
        driver: LCM: configuration file of the driver (docs/lcm.md). Default: the default configuration.
        rate: ROS 2: rate of the measurements [Hz]. Default: 1000.
        model: ROS 2: model file for the gravity compensation. Default: the nominal model from the SDF.
        enabled: ROS 2: enable and home the arm at the start.
    """
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.processes.pace import settle_memory
    from dvrk_drake.processes.simulated_arm import SimulatedArm, start_pose, stop_on_signals
    from dvrk_drake.processes.simulated_ros_arm import SimulatedRosArm
    from dvrk_drake.processes.teacher import EnterKey
    from dvrk_drake.systems.ros.crtk_driver import CrtkDriver
    from dvrk_drake.systems.ros.open_domain import domain_number

    connected.check(lcm={"driver": driver}, ros={"rate": rate, "model": model, "enabled": enabled})
    arm = mounted(load_arm(connected.arm), gravity)
    simulated_effects = None if effects is None else arm.effects.only(effects)
    start = start_pose(arm, pose, simulated_effects)
    simulated: SimulatedArm | SimulatedRosArm
    if connected.is_ros:
        domain_number(connected.domain)  # the driver has a different message, for its YAML file
        topics = CrtkDriver(domain=connected.domain, namespace=connected.topic or "", model=model or "")
        topics.rate = topics.rate if rate is None else rate
        topics.check()
        request_realtime(realtime)  # the threads of DDS inherit it
    else:
        configuration = driver_configuration(driver, connected.key, connected.lcm_url)
    print_line(f"starting the simulated {arm.name}")
    with interrupt_ends_process():
        if connected.is_ros:
            simulated = SimulatedRosArm(arm, topics, start, simulated_effects, enabled=enabled)
        else:
            simulated = SimulatedArm(arm, configuration, configuration.lcm_url, start, effects=simulated_effects)
        stopped = stop_on_signals()
    settle_memory()
    if not connected.is_ros:
        request_realtime(realtime)
    print_line(f"simulated {arm.name} on {simulated.source}; press Ctrl-C to end")
    pace = simulated.run(stopped, print_line, EnterKey.of_terminal())
    print_line(f"ended; {pace.describe()}")
