"""Publishes the joint states of a PSM over DDS at 200 Hz until it is terminated, as a process of its own.

Message k of the arm and of its jaw has the header stamp `START` + k / 200 s and the row `rows(k)`. Every tenth message
of the arm is preceded by an invalid one, as a dVRK sends them before homing.
"""

import sys
import threading

import numpy as np

START, PERIOD = 1_795_257_600_000_000_000, 5_000_000
DOMAIN_FILE = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""


def rows(k):
    """Returns q, qd and tau (3, 7) of message k, within the limits of a PSM."""
    phase = np.arange(21).reshape(3, 7) + 0.01 * k
    return np.sin(phase) * [0.3, 0.3, 0.05, 0.3, 0.3, 0.3, 0.3] + [0, 0, 0.1, 0, 0, 0, 0.3]


def main(domain, reliable):
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.systems.ros.domain import RosDomain, dds_topic, ros_qos
    from dvrk_drake.systems.ros.messages import Header, JointState, Time

    joints = list(load_arm("psm").joint_names)
    participant = RosDomain(domain).participant
    arm, jaw = (
        DataWriter(participant, Topic(participant, dds_topic(name), JointState), qos=ros_qos(5, reliable=reliable))
        for name in ("/dvrk/PSM1/measured_js", "/dvrk/PSM1/jaw/measured_js")
    )
    clock, k = threading.Event(), 0
    print("publishing", flush=True)
    while not clock.wait(PERIOD / 1e9):
        header = Header(Time(*divmod(START + k * PERIOD, 10**9)), "")
        q, qd, tau = rows(k).tolist()
        if k % 10 == 0:
            arm.write(JointState())
        arm.write(JointState(header, joints[:6], q[:6], qd[:6], tau[:6]))
        jaw.write(JointState(header, joints[6:], q[6:], qd[6:], tau[6:]))
        k += 1


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2] == "reliable")
