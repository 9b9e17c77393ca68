"""Commands that show an arm: its equations and its geometry."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

import dvrk_drake as dvrk
from dvrk_drake.cli import options, support
from dvrk_drake.errors import DvrkDrakeError


@options.app.command(group=options.MODEL)
def equations(
    *,
    arm: options.Arm,
    instrument: options.Instrument = "",
    format: Literal["latex", "python", "c"] | None = None,
    output: Annotated[str | None, Parameter(metavar="FILE")] = None,
    overwrite: options.Overwrite = False,
    gravity: options.Gravity = None,
) -> None:
    """Show the base parameters of gravity, or generate source code.

    Args:
        format: Generate source code of the gravity torque and its regressor in this language.
        output: File for the source code. Default: standard output.
    """
    from dvrk_drake.dynamics.symbolic_gravity import SymbolicPlant, derive_gravity
    from dvrk_drake.export import gravity_sources
    from dvrk_drake.models.files import atomic_write
    from dvrk_drake.reports.parameters import symbolic_model_page

    if output is not None:
        if format is None:
            raise DvrkDrakeError("--output requires --format latex, python or c")
        support.check_output(output, overwrite=overwrite)
    shown = support.mounted(dvrk.load_arm(arm, instrument), gravity)
    with support.Steps("deriving the gravity torque"):
        derived = derive_gravity(shown)
    if format is None:
        support.show_page(symbolic_model_page(derived, command=support.command_again("--format", "latex")))
        return
    writers = {
        "latex": lambda: gravity_sources.to_latex(derived, SymbolicPlant(shown).frame_poses()),
        "python": lambda: gravity_sources.to_python(derived),
        "c": lambda: gravity_sources.to_c(derived),
    }
    text = writers[format]()
    if output is None:
        sys.stdout.write(text)
        return
    with atomic_write(output) as stream:
        stream.write(text)
    support.print_written(output)


@options.app.command(group=options.MODEL)
def arm_file(
    model_file: Annotated[str, Parameter(metavar="MODEL_FILE")],
    /,
    *,
    output: Annotated[str, Parameter(metavar="FILE.yaml")],
    overwrite: options.Overwrite = False,
) -> None:
    """Write an arm file that describes a model file.

    It contains everything that is derived from the model file, so that you can change it. Commands also accept the
    model file itself as --arm.

    Args:
        model_file: URDF, SDF, MJCF (.xml), or Drake's model directives (.dmd.yaml).
        output: Arm file to write.
    """
    from dvrk_drake.models.arm_files import derived_arm_file
    from dvrk_drake.models.files import atomic_write

    if not output.lower().endswith((".yaml", ".yml")):
        raise DvrkDrakeError(f"--output {output}: the name of an arm file ends in .yaml")
    support.check_output(output, overwrite=overwrite)
    text = derived_arm_file(model_file, Path(output).parent)
    with atomic_write(output) as stream:
        stream.write(text)
    support.print_written(output, f"use it as --arm {output}")


@options.app.command(group=options.MODEL)
def view(
    *,
    arm: options.Arm,
    instrument: options.Instrument = "",
    live: Annotated[bool, Parameter(show_default=False)] = False,
    lcm_url: options.LcmUrl = "",
    port: options.Port = None,
) -> None:
    """Show an arm in a web browser.

    The controls are under Open Controls. Sliders set the joint positions, and the linkage stays closed. Buttons move
    the camera. Sliders from 0 to 1 show frames and gravity efforts, and select degrees.

    Args:
        live: Show the measured pose and efforts from the LCM messages of the arm, the commanded pose as a ghost, and
            the external force if it is published (--publish-force of control and bridge).
    """
    from dvrk_drake.processes.live_view import LiveForce, show_status
    from dvrk_drake.systems.arm_view.arm_view import ArmView
    from dvrk_drake.systems.lcm.arm_link import LcmArmLink
    from dvrk_drake.systems.lcm.lcm_network import usable_lcm_url

    if lcm_url and not live:
        raise DvrkDrakeError("--lcm-url requires --live")
    shown = dvrk.load_arm(arm, instrument)
    url = usable_lcm_url(lcm_url) if live else ""
    meshcat = dvrk.start_meshcat(shown, port=port)
    arm_view = ArmView(shown, meshcat)
    arm_view.add_view_buttons()
    ending = "press Stop, Escape or Ctrl-C to end"
    if live:
        link, force = LcmArmLink(shown, url, replays=True), LiveForce(shown, url)
        print(f"{shown.name} live at {meshcat.web_url()}; {ending}", flush=True)
        support.until_stopped(meshcat, lambda: show_status(arm_view, link, force))
        return
    arm_view.add_sliders()
    print(f"{shown.name} at {meshcat.web_url()}; the controls are under Open Controls; {ending}", flush=True)
    support.until_stopped(meshcat, arm_view.follow_controls)
