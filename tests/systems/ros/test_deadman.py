"""Tests the line with which the deadman process reports its connection. Other tests run it beside an arm."""

import os
import subprocess
import sys


def test_report_is_one_write_without_buffers():
    """A bridge must not read the end of the line separately. In a packet pipe, each write is one packet."""
    read_end, write_end = os.pipe2(os.O_DIRECT)
    code = "from dvrk_drake.systems.ros import deadman; deadman._report_connected(True)"
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    subprocess.run([sys.executable, "-c", code], stdout=write_end, env=environment, check=True)
    assert os.read(read_end, 100) == b"ready\n"
    os.close(read_end)
    os.close(write_end)
