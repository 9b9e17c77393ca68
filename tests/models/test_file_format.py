"""Versions of files: other major versions, newer ones and other files are refused with one line."""

import pytest

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import ArmDescription
from dvrk_drake.models.file_format import FileFormat
from dvrk_drake.models.plant import MODELS_FOLDER

FORMAT = FileFormat("dvrk_drake thing", 3, 2)


def test_same_and_older_minor_versions_are_accepted():
    for version in ("3.2", "3.1", "3"):
        FORMAT.check(f"dvrk_drake thing {version}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("dvrk_drake thing 3.3", 'allowed: "dvrk_drake thing 3.0" to "dvrk_drake thing 3.2". Install a newer'),
        ("dvrk_drake thing 4.0", "Install a newer version of dvrk_drake"),
        ("dvrk_drake thing 2.9", "Older files cannot be converted"),
        ("dvrk_drake arm 3.2", "format is 'dvrk_drake arm 3.2'; allowed: "),
        ("dvrk_drake thing", "allowed"),
        ("dvrk_drake thing 3.x", "allowed"),
        (3.2, "format is '3.2'; allowed"),
        (None, "allowed"),
        (["dvrk_drake thing 3.2"], "allowed"),
    ],
)
def test_other_formats_are_refused(text, message):
    with pytest.raises(ValueError, match=r"^format is ") as raised:
        FORMAT.check(text)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_arm_of_a_newer_version_is_refused_before_its_keys(tmp_path):
    text = (MODELS_FOLDER / "arms" / "psm.yaml").read_text()
    path = tmp_path / "arm.yaml"
    path.write_text(text)
    assert load_arm(path).name == "PSM"
    # The format may be omitted.
    path.write_text("\n".join(line for line in text.splitlines() if not line.startswith("format:")))
    assert load_arm(path).name == "PSM"
    path.write_text(text.replace("arm 1.0", "arm 2.0") + "\nnew_key: 1\n")
    with pytest.raises(ArmError, match=r'arm\.yaml: format is "dvrk_drake arm 2\.0"; .* Install a newer version'):
        load_arm(path)


def test_files_of_this_package_state_the_current_format():
    paths = [path for folder in ("arms", "mechanisms", "instruments") for path in (MODELS_FOLDER / folder).iterdir()]
    for path in paths:
        kind = path.parent.name.removesuffix("s")
        assert f"\nformat: {FileFormat(f'dvrk_drake {kind}', 1)}\n" in path.read_text(), path
    assert str(FileFormat.of(ArmDescription)) == "dvrk_drake arm 1.0"
