"""Command line in which a formula replaces the simulation, also in spawned workers.

python tests/support/formula_study.py study STUDY.yaml --output RESULTS.csv --workers 2
"""

import os
import signal
import sys
import time
from pathlib import Path

import numpy as np

import dvrk_drake.experiments.study_run as study_module
from dvrk_drake.experiments.simulation import Simulation
from dvrk_drake.recordings.recording import Recording

#: Environment variable with the path of a folder of tickets (files). If set, each simulation waits for a ticket and
#: removes it.
TICKETS = "DVRK_DRAKE_TEST_TICKETS"


def remove_ticket(folder):
    while True:
        for ticket in Path(folder).iterdir():
            try:
                ticket.unlink()
                return
            except FileNotFoundError:  # removed by another worker
                continue
        time.sleep(0.01)


def simulate(scenario):
    """Returns a simulation whose positions drift at a rate that depends on the seed and the parameter error."""
    if folder := os.environ.get(TICKETS):
        remove_ticket(folder)
    t = np.arange(0.0, scenario.duration + 1e-9, scenario.sample_period)
    rate = (1 + scenario.controller.parameter_error) * (scenario.seed % 1000) / 5e4
    q = np.array(scenario.start) + rate * t[:, None]
    return Simulation(Recording(q=q, qd=0 * q, tau=q / 10, t=t), np.hstack([q, 0 * q]), None, None)


_run_case = study_module.run_case


def run_case(scenario, measures):
    """Runs a case with the formula. A worker imports this module when it receives this function."""
    study_module.simulate = simulate
    return _run_case(scenario, measures)


if __name__ == "__main__":
    import formula_study  # workers do not import the main script

    from dvrk_drake.cli import main

    study_module.run_case = formula_study.run_case
    # A shell without job control starts background processes with SIGINT ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main(sys.argv[1:]))
