"""The verbs that show an arm: its equations, its shape."""

from __future__ import annotations

import argparse
import sys

from dvrk_drake.cli.support import (
    add_gravity,
    add_overwrite,
    check_output,
    mounted,
    quiet_drake,
    until_stopped,
)
from dvrk_drake.errors import DvrkDrakeError


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verbs and their options."""
    verb = verbs.add_parser("model", help="show an arm's gravity torque and regressor", description=_model_help)
    verb.add_argument("arm", help="mtml, mtmr, psm, or the path of an arm's YAML file")
    shown = verb.add_mutually_exclusive_group()
    for name in ("latex", "python", "c"):
        shown.add_argument(f"--{name}", dest="format", action="store_const", const=name, help=f"write {name} source")
    verb.add_argument("--output", metavar="FILE", help="write to a file instead of standard output")
    add_overwrite(verb)
    add_gravity(verb)
    verb.set_defaults(run=_model)

    verb = verbs.add_parser("view", help="show an arm in a browser: with sliders, or as it stands over LCM")
    verb.add_argument("arm", help="mtml, mtmr, psm, or the path of an arm's YAML file")
    verb.add_argument("--live", action="store_true", help="as its status messages tell; without sliders")
    verb.add_argument("--lcm-url", metavar="URL", help="of --live; default: LCM_DEFAULT_URL, or LCM's own")
    verb.add_argument("--port", type=int, help="of the page; default: a free one")
    verb.set_defaults(run=_view)


def _model(options: argparse.Namespace) -> None:
    from dvrk_drake.dynamics.gravity_regressor import derive_gravity
    from dvrk_drake.dynamics.symbolic_plant import SymbolicPlant
    from dvrk_drake.export import gravity_sources
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.models.files import atomic_write
    from dvrk_drake.reports.model import print_symbolic_model
    from dvrk_drake.reports.terminal_tables import make_console

    if options.output is not None:
        if options.format is None:
            raise DvrkDrakeError("--output needs to know what to write: --latex, --python or --c")
        check_output(options.output, overwrite=options.overwrite)
    arm = mounted(load_arm(options.arm), options.gravity)
    gravity = derive_gravity(arm)
    writers = {
        "latex": lambda gravity: gravity_sources.to_latex(gravity, SymbolicPlant(arm).frame_poses()),
        "python": gravity_sources.to_python,
        "c": gravity_sources.to_c,
    }
    if options.format is None:
        print_symbolic_model(make_console(), gravity)
        return
    text = writers[options.format](gravity)
    if options.output is None:
        sys.stdout.write(text)
    else:
        with atomic_write(options.output) as stream:
            stream.write(text)


def _view(options: argparse.Namespace) -> None:
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.processes.control import ArmLink
    from dvrk_drake.processes.lcm_network import open_lcm
    from dvrk_drake.processes.live_view import show_status
    from dvrk_drake.systems.arm_view import ArmView, start_meshcat

    quiet_drake()
    if options.lcm_url is not None and not options.live:
        raise DvrkDrakeError("--lcm-url is of --live")
    arm = load_arm(options.arm)
    url = open_lcm(options.lcm_url or "").get_lcm_url() if options.live else ""
    meshcat = start_meshcat(arm, port=options.port)
    view = ArmView(arm, meshcat)
    if options.live:
        link = ArmLink(arm, url, replays=True)
        print(f"{arm.name} live at {meshcat.web_url()}; end with Stop, Escape or Ctrl-C", flush=True)
        until_stopped(meshcat, lambda: show_status(view, link))
        return
    view.add_sliders()
    print(
        f"{arm.name} at {meshcat.web_url()}; sliders under Open Controls; end with Stop, Escape or Ctrl-C", flush=True
    )
    until_stopped(meshcat, view.follow_sliders)


_model_help = (
    "Prints the base parameters; with --latex, --python or --c the gravity torque and its regressor as source."
)
