"""Tests that the committed code of the LCM types equals the output of lcm-gen, and encodes and decodes correctly."""

import subprocess
import sys
from pathlib import Path

import pytest
from waiting import TIMEOUT

from dvrk_drake import lcmtypes
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_force, lcmt_dvrk_status
from dvrk_drake.models.lcm_messages import MESSAGE_VERSION

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
