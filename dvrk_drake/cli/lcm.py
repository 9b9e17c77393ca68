"""The verbs of the command line that talk LCM."""

from __future__ import annotations

import argparse
import sys
from contextlib import closing, nullcontext
from typing import TYPE_CHECKING

from dvrk_drake.cli.support import add_gravity, add_key, interrupt_ends_process, load_key, mounted, quiet_drake

if TYPE_CHECKING:
    from collections.abc import Callable

    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.models.arm_schema import Gains
    from dvrk_drake.processes.arm_controller import ArmController
    from dvrk_drake.processes.control import ArmLink
    from dvrk_drake.systems.friction_compensator import FrictionCompensator
    from dvrk_drake.systems.gravity_pid_controller import Mode


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verbs and their options."""
    _add_arm(verbs)
    _add_run(verbs)
    _add_key(verbs)


def _add_arm(verbs: argparse._SubParsersAction) -> None:
    verb = verbs.add_parser("arm", help="play an arm behind LCM: a simulated one with a hardware driver's safeguards")
    verb.add_argument("--arm", required=True, help="mtml, mtmr, psm, or the path of an arm's YAML file")
    verb.add_argument("--driver", metavar="FILE.yaml", help="configuration of its driver, fields as in DvrkDriver")
    verb.add_argument("--lcm-url", metavar="URL", help="default: the driver's, or LCM_DEFAULT_URL, or LCM's own")
    verb.add_argument("--pose", nargs="+", type=float, metavar="Q", help="where it starts [rad, m]; default: near zero")
    verb.add_argument("--meshcat", action="store_true", help="draw it in a browser")
    verb.add_argument("--realtime", action="store_true", help="real-time scheduling, or a warning where not permitted")
    add_key(verb)
    add_gravity(verb)
    verb.set_defaults(run=_arm)


def _arm(options: argparse.Namespace) -> None:
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.processes.lcm_network import open_lcm
    from dvrk_drake.processes.live_view import live_view
    from dvrk_drake.processes.pace import make_realtime, settle_memory
    from dvrk_drake.processes.simulated_arm import SimulatedArm, load_driver, start_pose, stop_on_signals
    from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver

    quiet_drake()
    arm = mounted(load_arm(options.arm), options.gravity)
    driver = DvrkDriver() if options.driver is None else load_driver(options.driver)
    driver.key_file = options.key or driver.key_file
    pose = start_pose(arm, options.pose)
    url = open_lcm(options.lcm_url or driver.lcm_url).get_lcm_url()
    with interrupt_ends_process():
        simulated = SimulatedArm(arm, driver, url, pose)
        stopped = stop_on_signals()
    with live_view(options.arm, url) if options.meshcat else nullcontext():
        if options.realtime:
            for warning in make_realtime():
                _warn(warning)
        settle_memory()
        print(f"simulated {arm.name} on LCM {url}; end with Ctrl-C", flush=True)
        pace = simulated.run(stopped, lambda line: print(line, flush=True))
    print(f"ended; {pace.late} ticks began more than a period late", flush=True)


def _add_run(verbs: argparse._SubParsersAction) -> None:
    verb = verbs.add_parser("run", help="compensate or hold an arm over LCM")
    add_control(verb)
    verb.add_argument("--mode", choices=("gravity", "damped", "hold"), default="gravity", help="default: gravity")
    verb.add_argument(
        "--gains", metavar="GAINS.yaml", help="from tune, for modes hold and damped; default: the arm's own"
    )
    verb.add_argument(
        "--friction-ratio",
        type=float,
        default=0.0,
        metavar="R",
        help="in mode gravity, the share of the friction to take off the hand; less where the arm could creep",
    )
    verb.add_argument(
        "--hysteresis-ratio",
        type=float,
        default=0.0,
        metavar="R",
        help="in mode gravity, the share of wide hysteresis to compensate: the arm stays where it was led",
    )
    verb.add_argument(
        "--friction", metavar="MODEL.yaml", help="from identify of a motion: whose friction; default: that of --model"
    )
    verb.set_defaults(run=_run)


def _add_key(verbs: argparse._SubParsersAction) -> None:
    verb = verbs.add_parser("key", help="make a key file, with which both sides authenticate their LCM messages")
    verb.add_argument("file", metavar="FILE", help="a new file, which only its owner may read")
    verb.set_defaults(run=_key)


def _key(options: argparse.Namespace) -> None:
    from dvrk_drake.models.lcm_messages import create_key_file

    create_key_file(options.file)
    print(f"{options.file}: copy it to the other side, e.g. with scp -p, and name it there and here with --key")


def _run(options: argparse.Namespace) -> None:
    from dvrk_drake.processes.control import control
    from dvrk_drake.processes.live_status import LiveLine, LiveStatus
    from dvrk_drake.processes.simulated_arm import stop_on_signals

    with interrupt_ends_process():
        compensator, gains = _friction_compensator(options), _gains(options)
        controller, link, period = ready_controller(options, options.mode, compensator, gains)
        stopped = stop_on_signals()
    arm = controller.arm
    print(
        f"{options.mode} of {arm.name} at {1 / period:.0f} Hz as sender {controller.sender_id}; "
        "Ctrl-C leaves it to its own hold",
        flush=True,
    )
    line, told = LiveLine(sys.stderr), [("", "")]

    def tell(status: LiveStatus) -> None:
        if (news := (status.state, status.problem)) == told[0]:
            line.show(lambda: str(status))
            return
        told[0] = news
        line.clear()
        print(status, flush=True)

    try:
        # A link of its own: what was said while the controller was compiled is past.
        control(link(), controller, stopped, tell)
    finally:
        line.clear()
    print(f"{arm.name} holds by itself", flush=True)


def _gains(options: argparse.Namespace) -> Gains | None:
    """What --gains names.

    Raises:
        ControllerError: it is no file of gains, they are not for the arm, or the arm is not to be held.
    """
    if options.gains is None:
        return None
    from dvrk_drake.errors import ControllerError
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.models.arm_schema import load_gains

    if options.mode == "gravity":
        raise ControllerError("--gains is for --mode hold or damped: in mode gravity the arm is not regulated")
    gains = load_gains(options.gains)
    if fault := load_arm(options.arm).gains_fault(gains):
        raise ControllerError(f"{options.gains}: {fault}")
    return gains


def _friction_compensator(options: argparse.Namespace) -> FrictionCompensator | None:
    """What --friction-ratio and --hysteresis-ratio ask for, with a warning where it cannot be had in full.

    Raises:
        ControllerError: it asks for what is not safe.
        ModelError: the model has no friction.
    """
    if options.friction_ratio == options.hysteresis_ratio == 0:
        return None
    from dvrk_drake.dynamics.friction_compensation import Friction, holding_error
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.errors import ControllerError
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.systems.friction_compensator import FrictionCompensator

    if options.mode != "gravity":
        raise ControllerError(
            "--friction-ratio and --hysteresis-ratio are for --mode gravity: an arm that is held or braked shall not "
            "be easy to move"
        )
    if options.model is None:
        raise ControllerError(
            "--friction-ratio and --hysteresis-ratio need --model: without friction an arm creeps if its weight is "
            "not known well"
        )
    arm, model = load_arm(options.arm), IdentifiedModel.load(options.model)
    error = holding_error(model)
    if options.friction_ratio and not error.any():
        raise ControllerError(
            f"--friction-ratio needs a --model from identify of poses at rest; {options.model} does not say how wrong "
            "its weight may be, so nothing would keep the arm from creeping"
        )
    friction = Friction.of_model(IdentifiedModel.load(options.friction or options.model, arm))
    compensator = FrictionCompensator(
        friction,
        ratio=options.friction_ratio,
        hysteresis_ratio=options.hysteresis_ratio,
        holding_error=error,
    )
    of_effects = zip(friction.effects, compensator.ratios, friction.springs_back, strict=True)
    less = {e.coordinate: r for e, r, springs_back in of_effects if not springs_back}
    if said := ", ".join(f"{name} {r:.2f}" for name, r in less.items() if r < 0.99 * options.friction_ratio):
        _warn(f"friction is compensated less where what remains must hold the arm against the model's error: {said}")
    return compensator


def add_control(verb: argparse.ArgumentParser) -> None:
    """Adds the options of `ready_controller`."""
    verb.add_argument("--arm", required=True, help="mtml, mtmr, psm, or the path of an arm's YAML file")
    verb.add_argument("--model", metavar="MODEL.yaml", help="from identify; default: what the arm's SDF states")
    verb.add_argument("--lcm-url", default="", metavar="URL", help="default: LCM_DEFAULT_URL, or LCM's own")
    verb.add_argument("--realtime", action="store_true", help="real-time scheduling, or a warning where not permitted")
    verb.add_argument(
        "--reset",
        action="store_true",
        help="say which fault the arm has or why it took over, if it did, and clear that before it is controlled",
    )
    add_key(verb)


def ready_controller(
    options: argparse.Namespace,
    mode: Mode,
    friction: FrictionCompensator | None = None,
    gains: Gains | None = None,
) -> tuple[ArmController, Callable[[], ArmLink], float]:
    """A controller of an arm that may be controlled, what opens a link to it, and the period of its statuses [s].

    With `friction` it compensates that as well; `gains` are what it holds with. With --reset a latched fault is said
    and cleared first, and an arm whose watchdog took over resumes. The link is to the session that was looked at: an
    arm that is restarted meanwhile is none.

    Raises:
        ModelError: the model is of another arm.
        KeyFileError: the key cannot be used.
        ControllerError: no arm there, or one that may not be controlled now.
    """
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.processes.arm_controller import ArmController
    from dvrk_drake.processes.control import ArmLink, first_status, reset_fault
    from dvrk_drake.processes.lcm_network import open_lcm
    from dvrk_drake.processes.pace import make_realtime, settle_memory

    quiet_drake()
    arm, key = load_arm(options.arm), load_key(options.key)
    model = IdentifiedModel.from_arm(arm) if options.model is None else IdentifiedModel.load(options.model, arm)
    if options.model is not None and (warning := model_warning(options.model, model)):
        _warn(warning)
    url = open_lcm(options.lcm_url).get_lcm_url()
    with closing(ArmLink(arm, url, key=key)) as link:
        if options.reset:
            reset_fault(link, _warn)
        status, period = first_status(link)
    controller = ArmController(arm, model, mode, period, friction, gains)
    if options.realtime:
        for warning in make_realtime():
            _warn(warning)
    settle_memory()
    return controller, lambda: ArmLink(arm, url, key=key, before=status), period


def model_warning(path: str, model: IdentifiedModel) -> str:
    """The joints of a model that did not pass validation, or that nothing but cross-validation judged; or ""."""
    from dvrk_drake.analysis.verdict import cross_validated_verdicts, unfit

    if model.validation is None:
        bad = unfit(cross_validated_verdicts(model), "usable")
        found = f"; cross-validated: {', '.join(bad)}" if bad else ""
        command = f"dvrk-drake validate {path} OTHER.csv --save"
        return f"{path}: no other recording has validated this model{found}; run: {command}"
    verdicts = model.validation.verdicts
    if not (bad := unfit({joint.name: verdicts[joint.name] for joint in model.joints}, "usable")):
        return ""
    where = model.validation.recording
    return f"{path}: did not pass validation on {where}: {', '.join(bad)}; their torque may be worse than none"


def _warn(text: str) -> None:
    print(f"dvrk-drake: warning: {text}", file=sys.stderr, flush=True)
