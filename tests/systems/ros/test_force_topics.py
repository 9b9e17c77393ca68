"""Topics of the estimated force: names, messages, and the bridge that publishes them."""

from types import SimpleNamespace

import numpy as np
import pytest

from dvrk_drake.lcmtypes import lcmt_dvrk_force

pytest.importorskip("cyclonedds")
from crtk_bench import CrtkBench


def test_bridge_publishes_force_and_covariance(monkeypatch):
    bridge, published = CrtkBench(monkeypatch, "psm").bridge, {}
    bridge.client.domain.advertise = lambda topic, message_type: SimpleNamespace(
        publish=lambda message: published.setdefault(topic, message)
    )
    force = lcmt_dvrk_force()
    force.utime, force.arm_name, force.frame_name = 1_700_000_000_250_000, "PSM", "tool"
    force.force, force.force_covariance = [1.0, np.nan, 3.0], np.arange(9.0).reshape(3, 3).tolist()
    bridge.send_force(force)
    names = ["/PSM/external_force/body/estimated_cf", "/PSM/external_force/body/covariance"]
    assert list(published) == names
    wrench, covariance = published.values()
    assert (wrench.header.stamp.sec, wrench.header.stamp.nanosec) == (1_700_000_000, 250_000_000)
    assert wrench.header.frame_id == "PSM/tool"
    np.testing.assert_array_equal([wrench.wrench.force.x, wrench.wrench.force.y, wrench.wrench.force.z], force.force)
    assert (wrench.wrench.torque.x, wrench.wrench.torque.y, wrench.wrench.torque.z) == (0.0, 0.0, 0.0)
    assert covariance.data == list(range(9))
    assert [(d.label, d.size, d.stride) for d in covariance.layout.dim] == [("row", 3, 9), ("column", 3, 3)]
