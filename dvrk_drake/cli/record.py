"""The verb `record`."""

from __future__ import annotations

import argparse
import sys

from dvrk_drake.cli.support import add_key, load_key, print_notes, seconds


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb and its options."""
    verb = verbs.add_parser(
        "record", help="record an arm over LCM; whatever ends it, the file is whole up to its last row"
    )
    verb.add_argument("output", metavar="OUTPUT", help="a new file: .csv, or .log for an LCM log")
    verb.add_argument("--arm", required=True, help="mtml, mtmr, psm, or the path of an arm's YAML file")
    verb.add_argument(
        "--duration", type=seconds, default=float("inf"), metavar="S", help="from the first status; default: to Ctrl-C"
    )
    verb.add_argument("--lcm-url", default="", metavar="URL", help="default: LCM_DEFAULT_URL, or LCM's own")
    add_key(verb)
    verb.set_defaults(run=_record)


def _record(options: argparse.Namespace) -> None:
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.processes.lcm_network import open_lcm
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.recorder import Recorder
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.recordings.recording_stream import check_stream_output

    arm = load_arm(options.arm)
    check_stream_output(options.output)
    url = open_lcm(options.lcm_url).get_lcm_url()
    recorder = Recorder(arm, options.output, url, load_key(options.key))
    line = LiveLine(sys.stderr)
    stopped = stop_on_signals()
    print(f"recording {arm.name} on LCM {url}; end with Ctrl-C", flush=True)
    try:
        recorder.run(options.duration, stopped, line.show)
    finally:
        line.clear()
    print(f"{options.output}: {recorder.stream.num_taken} rows", flush=True)
    print_notes(options.output, recorder.notes())
