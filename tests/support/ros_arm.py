"""Arm on DDS topics as a process of its own: latched states, and each received effort command as a measurement."""

import sys

STATES = ["DISABLED", "ENABLED", "PAUSED"]
STATE, MEASURED, COMMAND = "/MTML/operating_state", "/MTML/measured_js", "/MTML/servo_jf"


def main(number):
    from dvrk_drake.systems.ros.domain import RosDomain
    from dvrk_drake.systems.ros.messages import JointState, OperatingState

    domain = RosDomain(number)
    states = domain.advertise(STATE, OperatingState, latched=True)
    for state in STATES:
        states.publish(OperatingState(state=state))
    measured = domain.advertise(MEASURED, JointState)
    commands = domain.subscribe(COMMAND, JointState, depth=100)
    print("ready", flush=True)
    while True:
        domain.wait(1.0)
        for command, _ in commands.take():
            measured.publish(command)


if __name__ == "__main__":
    main(int(sys.argv[1]))
