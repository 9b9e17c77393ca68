"""Command that runs a simulated arm over LCM or ROS 2."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dvrk_drake.cli.app import HARDWARE, Arm, Gravity, Key, LcmUrl, Model, Realtime, app, whole_number
from dvrk_drake.cli.support import (
    check_ros_options,
    interrupt_ends_process,
    mounted,
    print_warning,
    quiet_drake,
    warn_of_driver,
)

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm as LoadedArm
    from dvrk_drake.models.effects_schema import ArmEffects


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SimulatedRos:
    """Options of `sim-arm` for a simulated arm on ROS 2."""

    ros: Annotated[
        bool, Parameter(show_default=False, help="Use ROS 2 instead of LCM, with the CRTK topics of a dVRK.")
    ] = False
    topic: Annotated[
        str | None,
        Parameter(
            metavar="NAMESPACE",
            help="With --ros: namespace of the topics. Default: the name of the arm; /PSM1 for psm.",
        ),
    ] = None
    domain: Annotated[
        int | None,
        Parameter(
            metavar="N", converter=whole_number, help="With --ros: ROS domain. Default: $ROS_DOMAIN_ID, or else 0."
        ),
    ] = None
    rate: Annotated[
        float | None, Parameter(metavar="HZ", help="With --ros: rate of the measurements [Hz]. Default: 1000.")
    ] = None
    model: Annotated[
        Model | None,
        Parameter(help="With --ros: model file for the gravity compensation. Default: the nominal model from the SDF."),
    ] = None
    enabled: Annotated[
        bool, Parameter(show_default=False, help="With --ros: enable and home the arm at the start.")
    ] = False


_ROS = SimulatedRos()


@app.command(group=HARDWARE)
def sim_arm(
    *,
    arm: Arm,
    driver: Annotated[str | None, Parameter(metavar="FILE.yaml")] = None,
    lcm_url: LcmUrl = "",
    key: Key = None,
    pose: Annotated[list[float] | None, Parameter(metavar="Q ..", consume_multiple=True)] = None,
    gravity: Gravity = None,
    effects: Annotated[list[str] | None, Parameter(metavar="NAME ..", consume_multiple=True)] = None,
    meshcat: Annotated[bool, Parameter(show_default=False)] = False,
    realtime: Realtime = False,
    ros: SimulatedRos = _ROS,
) -> None:
    """Run a simulated arm on LCM, with its driver and command guard, or on ROS 2, with the topics of a dVRK.

    Args:
        driver: Configuration file of the driver (docs/lcm.md). Default: the default configuration.
        pose: Initial joint positions [rad; m if prismatic]. Default: near zero, within the joint limits.
        effects: Simulated effects, e.g. friction, or all (docs/simulated_effects.md). Default: none.
        meshcat: Show the arm in a web browser.
    """
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.processes.live_view import live_view
    from dvrk_drake.processes.pace import make_realtime, settle_memory
    from dvrk_drake.processes.simulated_arm import SimulatedArm, load_driver, start_pose, stop_on_signals
    from dvrk_drake.processes.teacher import EnterKey
    from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver
    from dvrk_drake.systems.lcm.lcm_network import open_lcm

    quiet_drake()
    lcm_only = {"driver": driver, "lcm_url": lcm_url, "key": key, "meshcat": meshcat}
    check_ros_options(ros.ros, vars(ros) | {"ros": None}, lcm_only)
    simulated_arm = mounted(load_arm(arm), gravity)
    simulated_effects = None if effects is None else simulated_arm.effects.only(effects)
    if ros.ros:
        _run_ros_arm(simulated_arm, ros, pose, simulated_effects, realtime)
        return
    configuration = DvrkDriver() if driver is None else load_driver(driver)
    configuration.key_file = key or configuration.key_file
    warn_of_driver(configuration)
    start = start_pose(simulated_arm, pose, simulated_effects)
    url = open_lcm(lcm_url or configuration.lcm_url).get_lcm_url()
    print(f"starting the simulated {simulated_arm.name}", flush=True)
    with interrupt_ends_process():
        simulated = SimulatedArm(simulated_arm, configuration, url, start, effects=simulated_effects)
        stopped = stop_on_signals()
    with live_view(arm, url) if meshcat else nullcontext():
        settle_memory()
        if realtime:
            for warning in make_realtime():
                print_warning(warning)
        print(f"simulated {simulated_arm.name} on LCM {url}; press Ctrl-C to end", flush=True)
        pace = simulated.run(stopped, lambda line: print(line, flush=True), EnterKey.of_terminal())
    print(f"ended; {pace.describe()}", flush=True)


def _run_ros_arm(
    arm: LoadedArm, options: SimulatedRos, pose: list[float] | None, effects: ArmEffects | None, realtime: bool
) -> None:
    """Runs the simulated arm of `sim-arm --ros` until a signal.

    Raises:
        DvrkDrakeError: An option is not valid, or the ROS domain cannot be used.
    """
    from dvrk_drake.processes.pace import make_realtime, settle_memory
    from dvrk_drake.processes.simulated_arm import start_pose, stop_on_signals
    from dvrk_drake.processes.simulated_ros_arm import SimulatedRosArm
    from dvrk_drake.systems.ros.crtk_driver import CrtkDriver
    from dvrk_drake.systems.ros.open_domain import domain_number

    domain_number(options.domain)  # the driver has a different message, for its YAML file
    driver = CrtkDriver(domain=options.domain, namespace=options.topic or "", model=options.model or "")
    if options.rate is not None:
        driver.rate = options.rate
        driver.check()
    start = start_pose(arm, pose, effects)
    print(f"starting the simulated {arm.name}", flush=True)
    if realtime:
        for warning in make_realtime():
            print_warning(warning)
    with interrupt_ends_process():
        simulated = SimulatedRosArm(arm, driver, start, effects, enabled=options.enabled)
        stopped = stop_on_signals()
    settle_memory()
    print(f"simulated {arm.name} on {simulated.source}; press Ctrl-C to end", flush=True)
    pace = simulated.run(stopped, lambda line: print(line, flush=True))
    print(f"ended; {pace.describe()}", flush=True)
