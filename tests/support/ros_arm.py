"""Arm on DDS topics as a process of its own: latched states, and each received effort command as a measurement.

It prints a line for each `hold`.
"""

import sys

STATES = ["DISABLED", "PAUSED", "ENABLED"]
STATE, MEASURED, COMMAND = "/MTML/operating_state", "/MTML/measured_js", "/MTML/servo_jf"
HOLD = "/MTML/hold"


def main(number):
    from dvrk_drake.systems.ros.domain import RosDomain
    from dvrk_drake.systems.ros.messages import Empty, JointState, OperatingState

    domain = RosDomain(number)
    states = domain.advertise(STATE, OperatingState, latched=True)
    for state in STATES:
        states.publish(OperatingState(state=state))
    measured = domain.advertise(MEASURED, JointState)
    commands = domain.subscribe(COMMAND, JointState, depth=100)
    holds = domain.subscribe(HOLD, Empty, depth=100)
    print("ready", flush=True)
    while True:
        domain.wait(1.0)
        for command, _ in commands.take():
            measured.publish(command)
        for _ in holds.take():
            print("hold", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]))
