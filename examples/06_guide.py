# /// script
# requires-python = ">=3.11"
# dependencies = ["dvrk_drake"]
# ///
"""Lets a hand lead a simulated arm and release it: in mode "guide" the arm stays where the hand leaves it.

The simulated arm has all effects of a real arm: friction, cables, encoders, motors and delays.
"""

from dataclasses import replace
from pathlib import Path

import dvrk_drake as dvrk

FILE = Path(__file__).with_name("simulated_effects.yaml")  # the hand releases the arm at the last time of its path
REST = 0.5  # time for which the hand rests before the release [s]

for mode in ("gravity", "guide"):
    scenario = dvrk.load_scenario(str(FILE), [f"controller.mode={mode}"])
    last = scenario.hand.path[-1]
    scenario.hand.path.append(replace(last, time=last.time + REST))
    run = dvrk.simulate(scenario)
    q = run.state_true[:, : scenario.mounted_arm.num_joints]
    released = run.time >= scenario.hand.path[-1].time
    motion = abs(q[released] - q[released][0]).max(axis=0)
    print(f"{mode}: largest motion after the release [mrad]", (1e3 * motion).round(1))
