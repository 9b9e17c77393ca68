"""Tests message keys: key files, signatures, and rejected messages."""

import hashlib
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from command_output import assert_refused
from waiting import TIMEOUT

from dvrk_drake import lcmtypes
from dvrk_drake.cli import main
from dvrk_drake.errors import KeyFileError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_force, lcmt_dvrk_status
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.lcm_messages import MESSAGE_VERSION, MessageKey, create_key_file
from dvrk_drake.processes.simulated_arm import load_driver

KEY = bytes(range(32))


def write(path, content, mode=0o600):
    path.write_bytes(content)
    path.chmod(mode)
    return path


@pytest.mark.parametrize("message", [Command(), Status()])
def test_signed_message_is_verified_and_decoded(message):
    key, message.utime, message.arm_name = MessageKey(KEY), 12345, "MTML"
    data = message.encode()
    signed = key.sign(data)
    assert key.verify(signed) and not key.verify(data)
    back = type(message).decode(signed)
    assert (back.utime, back.arm_name, back.mac_size) == (12345, "MTML", 16)
    # Independent computation of the authentication code, as in a bridge in another language.
    assert back.mac == hashlib.blake2b(data[:-1], key=KEY, digest_size=16).digest()
    assert back.encode() == signed


def test_any_other_byte_length_or_key_is_not_authentic():
    key, data = MessageKey(KEY), Command().encode()
    signed = key.sign(data)
    for k in range(len(signed)):
        for bit in range(8):
            assert not key.verify(signed[:k] + bytes([signed[k] ^ 1 << bit]) + signed[k + 1 :])
        assert not key.verify(signed[:k])
    assert not key.verify(signed + b"\0") and not key.verify(b"") and not key.verify(bytes(17))
    assert not MessageKey(KEY[:-1]).verify(signed)
    # The signature depends on the message type, so a status cannot be sent as a command.
    other = key.sign(Status().encode())
    assert not key.verify(signed[:8] + other[8:])


@pytest.mark.parametrize("size", [16, 32, 64])
def test_key_is_the_content_of_its_file(tmp_path, size):
    content = os.urandom(size)
    signed = MessageKey.load(write(tmp_path / "a.key", content)).sign(Command().encode())
    assert MessageKey(content).verify(signed)


@pytest.mark.parametrize(
    ("content", "mode", "message"),
    [
        (KEY, 0o640, r"a\.key: other users have access to this key \(mode 0640\)\. Run: chmod 600 .*a\.key"),
        (KEY, 0o604, r"a\.key: other users have access to this key \(mode 0604\)"),
        (KEY, 0o602, r"a\.key: other users have access to this key \(mode 0602\)"),
        (KEY[:15], 0o600, r"a\.key: the key has 15 bytes; allowed: 16 to 64\. Create a key with: dvrk-drake keygen"),
        (b"", 0o600, r"a\.key: the key has 0 bytes"),
        (bytes(65), 0o600, r"a\.key: the key has more than 64 bytes"),
        (None, 0o600, r"a\.key: no such file"),
    ],
)
def test_invalid_keys_are_refused_in_one_line(tmp_path, content, mode, message, capsys):
    path = tmp_path / "a.key"
    if content is not None:
        write(path, content, mode)
    assert_refused(KeyFileError, message, MessageKey.load, path)
    for command in (
        ["control", "--arm", "mtml"],
        ["sim-arm", "--arm", "mtml"],
        ["record", str(tmp_path / "a.csv"), "--arm", "mtml"],
    ):
        assert main([*command, "--key", str(path), "--lcm-url", "memq://"]) == 2
        said = capsys.readouterr().err
        assert said.startswith("dvrk-drake: error: ") and said.count("\n") == 1 and "a.key: " in said


def test_folder_is_refused_as_key(tmp_path):
    assert_refused(KeyFileError, "is not a file but a folder", MessageKey.load, tmp_path)


def test_command_creates_a_key_and_does_not_overwrite_it(tmp_path, capsys):
    first, second = tmp_path / "a.key", tmp_path / "b.key"
    before = os.umask(0)
    try:
        assert main(["keygen", "--output", str(first)]) == main(["keygen", "--output", str(second)]) == 0
    finally:
        os.umask(before)
    assert f"{first}: copy the file to the other computer" in capsys.readouterr().out
    assert stat.S_IMODE(first.stat().st_mode) == 0o600
    content = first.read_bytes()
    assert len(content) == 32 and content != second.read_bytes()
    MessageKey.load(first)
    assert main(["keygen", "--output", str(first)]) == 2
    assert "a.key already exists, and a key is never overwritten" in capsys.readouterr().err
    assert first.read_bytes() == content
    with pytest.raises(KeyFileError, match="cannot be written: No such file or directory"):
        create_key_file(tmp_path / "no" / "a.key")


def test_key_path_is_relative_to_the_driver_file(tmp_path):
    write(tmp_path / "a.key", KEY)
    (tmp_path / "driver.yaml").write_text('key_file: a.key\ncontrol_modes: [position, "off"]\n')
    driver = load_driver(tmp_path / "driver.yaml")
    assert driver.load_key().verify(MessageKey(KEY).sign(Command().encode()))
    assert driver.accepted_modes() == (Command.POSITION, Command.OFF)
    (tmp_path / "driver.yaml").write_text(f"key_file: {tmp_path / 'b.key'}\n")
    assert_refused(KeyFileError, r"b\.key: no such file", load_driver(tmp_path / "driver.yaml").load_key)
    (tmp_path / "driver.yaml").write_text("{}\n")
    assert load_driver(tmp_path / "driver.yaml").load_key() is None


# Tests that the committed code of the LCM types equals the output of lcm-gen, and encodes and decodes correctly.


FOLDER = Path(lcmtypes.__file__).parent
TYPES = [lcmt_dvrk_command, lcmt_dvrk_force, lcmt_dvrk_status]
LCM_GEN = Path(sys.executable).with_name("lcm-gen")


def test_committed_python_equals_output_of_lcm_gen(tmp_path):
    if not LCM_GEN.exists():
        pytest.skip(f"no {LCM_GEN}: the lcm wheel ships it")
    sources = sorted(str(path) for path in FOLDER.glob("*.lcm"))
    subprocess.run([LCM_GEN, "-p", "--ppath", tmp_path, *sources], check=True, timeout=TIMEOUT)
    generated = {path.name: path.read_text() for path in (tmp_path / "dvrk_drake" / "lcmtypes").glob("*.py")}
    assert len(generated) == 4
    assert generated == {path.name: path.read_text() for path in FOLDER.glob("*.py")}


@pytest.mark.parametrize("type_", TYPES)
def test_every_field_and_constant_has_a_comment_before_it(type_):
    lines = [line.strip() for line in (FOLDER / f"{type_.__name__}.lcm").read_text().splitlines()]
    fields = [i for i, line in enumerate(lines) if line.endswith(";") and not line.startswith(("package", "//"))]
    assert len(fields) >= len(type_.__slots__)
    assert not [lines[i] for i in fields if not lines[i - 1].startswith("//")]


def test_codes_of_one_kind_are_distinct():
    for prefix in ("STATE_", "FAULT_", "REFUSAL_", "FLAG_"):
        codes = [value for name, value in vars(lcmt_dvrk_status).items() if name.startswith(prefix)]
        assert len(codes) == len(set(codes)) > 3


def test_layout_is_that_of_the_stated_version():
    """A changed layout needs a new major `MESSAGE_VERSION`, because released programs cannot decode it."""
    fingerprints = [type_._get_packed_fingerprint().hex() for type_ in TYPES]
    assert (MESSAGE_VERSION, fingerprints) == ("1.0", ["b48fa772aafdf43e", "325abd2a22080fcd", "31f33904d8a0f090"])
