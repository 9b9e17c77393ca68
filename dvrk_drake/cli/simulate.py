"""The verb `simulate` of the command line."""

from __future__ import annotations

import argparse

import dvrk_drake as dvrk
from dvrk_drake.cli.support import ProgressBar, add_overwrite, check_output, made_folder, quiet_drake, until_stopped


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb and its options."""
    verb = verbs.add_parser("simulate", help="simulate an arm under control, as a scenario file says, and record it")
    verb.add_argument("scenario", metavar="ARM_OR_SCENARIO", help="mtml, mtmr, psm: holds its home; or scenario.yaml")
    verb.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="changes the scenario, e.g. controller.mode=gravity; again for more",
    )
    verb.add_argument("--output", metavar="RECORDING.csv", help="write t, q, qd and tau")
    add_overwrite(verb)
    verb.add_argument("--plots", metavar="DIR", help="write plots into this folder")
    verb.add_argument("--meshcat", action="store_true", help="show it in a browser, in real time")
    verb.set_defaults(run=_simulate)


def _simulate(options: argparse.Namespace) -> None:
    from dvrk_drake.reports.figures import plot_simulation
    from dvrk_drake.reports.terminal_tables import make_console, print_simulation

    quiet_drake()
    scenario = dvrk.load_scenario(options.scenario, options.set)
    plots = None if options.plots is None else made_folder(options.plots)
    if options.output is not None:
        check_output(options.output, options.scenario, scenario.controller.model, overwrite=options.overwrite)
    meshcat = dvrk.start_meshcat(scenario.mounted_arm) if options.meshcat else None
    if meshcat is not None:
        print(f"{scenario.mounted_arm.name} at {meshcat.web_url()}", flush=True)
    with ProgressBar("simulating") as bar:
        simulation = dvrk.simulate(scenario, meshcat=meshcat, progress=bar)
    print_simulation(make_console(), simulation, scenario.mounted_arm)
    if options.output is not None:
        dvrk.write_recording(simulation.recording, options.output)
        print(f"recording: {options.output}, {len(simulation.recording)} rows")
    if plots is not None:
        plot_simulation(plots / "positions.png", simulation, scenario)
        print(f"plots: {plots}")
    if meshcat is not None:
        print("the page can play the motion again; end with Stop, Escape or Ctrl-C", flush=True)
        until_stopped(meshcat)
