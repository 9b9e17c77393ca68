"""Tests atomic writing and exact round trips."""

from __future__ import annotations

import errno
import os
import stat

import numpy as np
import pytest
from forked import public_folder, run_unprivileged
from recordings import random_recording, write_text

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.recordings.formats import read_recording, write_recording


@pytest.mark.parametrize("absent", [(), ("t",), ("qd",), ("tau",), ("t", "qd", "tau")])
def test_csv_round_trip_is_exact(tmp_path, absent):
    recording = random_recording(**dict.fromkeys(absent))
    recording.q[0, :4] = [5e-324, 1.7976931348623157e308, -0.0, 0.1 + 0.2]
    write_recording(recording, tmp_path / "out.csv")
    again = read_recording(tmp_path / "out.csv")
    for name in ("t", "q", "qd", "tau"):
        if name in absent:
            assert getattr(again, name) is None
        else:
            assert getattr(again, name).tobytes() == np.ascontiguousarray(getattr(recording, name)).tobytes()
    assert (tmp_path / "out.csv").read_bytes().count(b"\r") == 0


def test_failed_write_keeps_the_old_file(tmp_path):
    path = tmp_path / "out.csv"
    write_text(tmp_path, "old").rename(path)
    before = path.read_bytes()
    with pytest.raises(KeyboardInterrupt), atomic_write(path) as stream:
        stream.write("new")
        raise KeyboardInterrupt
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_unwritable_paths_are_refused(tmp_path):
    for path, match in (
        (tmp_path / "no" / "out.csv", r"no/out\.csv cannot be written: No such file or directory"),
        (tmp_path, "is not a regular file"),
        (os.devnull, "/dev/null is not a regular file and cannot be replaced"),
    ):
        with pytest.raises(DvrkDrakeError, match=match), atomic_write(path) as stream:
            stream.write("x")
    assert list(tmp_path.iterdir()) == []
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)


def test_full_disk_raises_a_package_error(tmp_path):
    match = r"out\.csv cannot be written: No space left"
    with pytest.raises(DvrkDrakeError, match=match), atomic_write(tmp_path / "out.csv"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.iterdir()) == []


def test_other_errors_of_the_caller_are_unchanged(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_write(tmp_path / "out.csv"):
        (tmp_path / "absent").read_text()


def test_a_read_only_file_is_not_replaced():
    with public_folder() as folder:
        path = write_text(folder, "old")
        path.chmod(0o444)

        def check():
            with pytest.raises(DvrkDrakeError, match="cannot be written: the file is read-only"), atomic_write(path):
                pass

        run_unprivileged(check)
        assert path.read_text() == "old"


def test_links_and_permissions_are_kept(tmp_path):
    path, link = write_text(tmp_path, "old"), tmp_path / "link.csv"
    path.chmod(0o640)
    link.symlink_to(path)
    with atomic_write(link) as stream:
        stream.write("new\r\n")
    assert link.is_symlink()
    assert path.read_bytes() == b"new\r\n"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def test_new_file_has_the_permissions_of_the_umask(tmp_path):
    old = os.umask(0o027)
    try:
        with atomic_write(tmp_path / "out.bin", "wb") as stream:
            stream.write(b"\x00\xff")
    finally:
        os.umask(old)
    assert (tmp_path / "out.bin").read_bytes() == b"\x00\xff"
    assert stat.S_IMODE((tmp_path / "out.bin").stat().st_mode) == 0o640


def test_umask_of_the_process_is_not_changed(tmp_path, monkeypatch):
    """Files that other threads create in the meantime would be writable by everyone."""
    monkeypatch.setattr(os, "umask", lambda mask: pytest.fail("the umask is changed"))
    with atomic_write(tmp_path / "out.csv") as stream:
        stream.write("new")
    assert (tmp_path / "out.csv").read_text() == "new"


def test_content_is_on_the_disk_before_the_file_is_replaced(tmp_path, monkeypatch):
    calls, path = [], tmp_path / "out.csv"
    fsync, replace_file = os.fsync, os.replace

    def synced(handle):
        is_folder = stat.S_ISDIR(os.fstat(handle).st_mode)
        calls.append("folder" if is_folder else os.fstat(handle).st_size)
        fsync(handle)

    def replaced(source, target):
        calls.append("replaced")
        replace_file(source, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", replaced)
    with atomic_write(path) as stream:
        stream.write("12345")
    assert calls == [5, "replaced", "folder"]


def test_suffix_of_a_bag_may_be_in_any_case(tmp_path):
    arm, path = load_arm("mtml"), tmp_path / "motion.MCAP"
    recording = random_recording()
    write_recording(recording, path, arm)
    assert path.read_bytes().startswith(b"\x89MCAP0\r\n")
    np.testing.assert_allclose(read_recording(path, arm).q, recording.q, atol=1e-12)
