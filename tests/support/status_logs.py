"""Creates statuses of an MTM with random measurements, and LCM logs."""

import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.reader_lcm import LcmEvent, event_bytes

ARM = load_arm("mtml")
N = ARM.num_joints
START = 1_795_257_600_000_000


def statuses(count=20, seed=1, **changes):
    """Returns statuses 1 ms apart with random measurements inside the limits."""
    generator = np.random.default_rng(seed)
    result = []
    for k, q in enumerate(ARM.sample_poses(count, generator)):
        status = Status()
        status.utime, status.sequence, status.session_id = START + 1000 * k, 100 + k, 77
        status.arm_name, status.num_joints, status.guard_state = "MTML", N, Status.STATE_HOLD
        status.position = q.tolist()
        status.velocity, status.effort_measured = generator.uniform(-0.1, 0.1, (2, N)).tolist()
        status.position_commanded, status.effort_commanded = status.position, status.effort_measured
        status.joint_flags = [0] * N
        for name, value in changes.items():
            setattr(status, name, value)
        result.append(status)
    return result


def log_bytes(messages, channel="DVRK_STATUS_MTML"):
    data = [m if isinstance(m, bytes) else m.encode() for m in messages]
    return b"".join(event_bytes(LcmEvent(k, START + 1000 * k, channel, d)) for k, d in enumerate(data))
