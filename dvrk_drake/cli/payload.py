"""The verb `payload`."""

from __future__ import annotations

import argparse
import json
import sys

from dvrk_drake.cli.dynamics import refuse_unusable
from dvrk_drake.cli.support import ProgressBar, add_gravity, add_overwrite, check_output, mounted, print_notes


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb and its options."""
    verb = verbs.add_parser("payload", help="say what was added to an arm between two recordings of one motion")
    verb.add_argument("reference", metavar="REFERENCE", help="recording of the motion without the payload")
    verb.add_argument("loaded", metavar="LOADED", help="recording of the same motion with it")
    source = verb.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--arm", help="the arm: mtml, mtmr, psm, or a YAML file; its model is identified from REFERENCE"
    )
    source.add_argument("--model", metavar="MODEL.yaml", help="its model, identified from a motion")
    verb.add_argument("--link", help="link of the SDF that carries it, compared with all others; default: the best")
    verb.add_argument(
        "--coordinates", choices=("joint", "actuator"), default="joint", help="what q and tau are of; default: joint"
    )
    verb.add_argument("--json", metavar="FILE", help="write the estimates as JSON")
    add_overwrite(verb)
    add_gravity(verb)
    verb.set_defaults(run=_payload)


def _payload(options: argparse.Namespace) -> None:
    from dvrk_drake.analysis.dynamic.dynamic_identification import identify_dynamic
    from dvrk_drake.analysis.payload.payload import check_links, estimate_payload
    from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.errors import ModelError
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.models.files import atomic_write
    from dvrk_drake.recordings.recording import read_recording
    from dvrk_drake.reports.payload import describe_better_links, print_links, print_payload
    from dvrk_drake.reports.terminal_tables import make_console

    model = None if options.model is None else IdentifiedModel.load(options.model)
    if model is not None and options.gravity is not None:
        raise ModelError(f"{options.model}: states its gravity; --gravity is for --arm")
    arm = mounted(load_arm(options.arm), options.gravity) if model is None else model.load_arm()
    check_links(DynamicRegressor(arm), [] if options.link is None else [options.link])
    if options.json is not None:
        check_output(options.json, options.reference, options.loaded, overwrite=options.overwrite)
    console = make_console()
    recordings = []
    for path in (options.reference, options.loaded):
        recordings.append(read_recording(path, arm, options.coordinates))
        print_notes(path, recordings[-1].notes)
        refuse_unusable(console, recordings[-1], arm)
    reference, loaded = recordings
    with ProgressBar("estimating") as (progress, task):
        if model is None:
            share = 50.0
            model = identify_dynamic(reference, arm, lambda done: progress.update(task, completed=50 * done)).model
        else:
            share = 0.0
        estimates = estimate_payload(
            reference,
            loaded,
            model.dynamic_model,
            progress=lambda done: progress.update(task, completed=share + (100 - share) * done),
        )
    chosen = estimates if options.link is None else [p for p in estimates if p.link == options.link]
    warning = describe_better_links(chosen[0], estimates)
    if options.link is None or warning is not None:
        print_links(console, estimates)
    if warning is not None:
        print(f"dvrk-drake: warning: {warning}", file=sys.stderr, flush=True)
    print_payload(console, chosen[0], estimates)
    if options.json is not None:
        with atomic_write(options.json) as stream:
            json.dump([payload.as_dict(estimates) for payload in chosen], stream, indent=2)
            stream.write("\n")
