"""The verb `payload`."""

from __future__ import annotations

import argparse

import dvrk_drake as dvrk
from dvrk_drake.cli.support import (
    ProgressBar,
    add_gravity,
    add_overwrite,
    check_output,
    mounted,
    print_notes,
    print_warnings,
    write_json,
)
from dvrk_drake.errors import ModelError


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
    from dvrk_drake.reports.payload import print_links, print_payload
    from dvrk_drake.reports.terminal_tables import make_console

    model = None if options.model is None else dvrk.IdentifiedModel.load(options.model)
    if model is not None and options.gravity is not None:
        raise ModelError(f"{options.model}: states its gravity; --gravity is for --arm")
    arm = mounted(dvrk.load_arm(options.arm), options.gravity) if model is None else model.arm
    if options.json is not None:
        check_output(options.json, options.reference, options.loaded, overwrite=options.overwrite)
    reference, loaded = (dvrk.read_recording(p, arm, options.coordinates) for p in (options.reference, options.loaded))
    for recording in (reference, loaded):
        print_notes(recording.source, recording.notes)
    with ProgressBar("estimating") as bar:
        result = dvrk.payload(reference, loaded, model or arm, options.link, progress=bar)
    console = make_console()
    other_link = [warning for warning in result.warnings if warning.kind == "other link"]
    if options.link is None or other_link:
        print_links(console, result.estimates)
    print_warnings(console, other_link)
    print_payload(console, result.payload, result.estimates)
    if options.json is not None:
        write_json(options.json, result.as_dicts())
