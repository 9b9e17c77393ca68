"""Packages import in one direction: `models` is the lowest package, `cli` the highest."""

import ast
from functools import cache

import pytest
from repository import ROOT

#: Packages that each package may import, besides itself and `COMMON`. CONTRIBUTING.md has a table.
ALLOWED = {
    "models": set(),
    "recordings": {"models"},
    "dynamics": {"models", "recordings"},
    "export": {"models", "recordings", "dynamics"},
    "systems": {"models", "recordings", "dynamics"},
    "analysis": {"models", "recordings", "dynamics"},
    "processes": {"models", "recordings", "dynamics", "export", "systems", "analysis"},
    "experiments": {"models", "recordings", "dynamics", "export", "systems", "analysis"},
}
ALLOWED["reports"] = ALLOWED.keys() - {"reports"}
ALLOWED["cli"] = ALLOWED.keys() - {"cli"}
#: Modules that every package may import and that import only `errors`.
COMMON = {"errors", "progress", "workers", "lcmtypes"}
PACKAGE = ROOT / "dvrk_drake"
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in PACKAGE.rglob("*.py")
}


@cache
def imports_of(source: str) -> set[str]:
    """Returns the names of all modules that a source imports, also in functions and under TYPE_CHECKING."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 or "lcm-gen" in source, "relative imports are not used"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.startswith("dvrk_drake.")}


def package_of(module: str) -> str:
    """Returns the package of a module: "models" for `dvrk_drake.models.arm`, "" for `dvrk_drake`."""
    return module.partition(".")[2].partition(".")[0]


def test_all_packages_are_listed():
    packages = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()}
    modules = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}
    assert packages | modules == ALLOWED.keys() | COMMON


@pytest.mark.parametrize("package", sorted(ALLOWED.keys() | COMMON))
def test_package_imports_only_allowed_packages(package):
    allowed = {package, "errors"} if package in COMMON else {package, *ALLOWED[package], *COMMON}
    wrong = [
        f"{module} imports {name}"
        for module, path in MODULES.items()
        if package_of(module) == package
        for name in imports_of(path.read_text())
        if package_of(name) not in allowed
    ]
    assert not wrong, "\n".join(sorted(wrong))


def test_folders_of_analysis_import_only_previous_folders():
    folders = ["observations", "estimation", "excitation"]
    wrong = [
        f"{module} imports {name}"
        for module, path in MODULES.items()
        for k, folder in enumerate(folders)
        if module.startswith(f"dvrk_drake.analysis.{folder}.")
        for name in imports_of(path.read_text())
        if name.startswith("dvrk_drake.analysis.") and name.split(".")[2] not in folders[: k + 1]
    ]
    assert not wrong, "\n".join(sorted(wrong))


def test_no_two_modules_import_each_other():
    imports = {module: imports_of(path.read_text()) for module, path in MODULES.items()}
    # An imported name is a module, or belongs to one.
    modules = {m: {n if n in MODULES else n.rpartition(".")[0] for n in names} - {m} for m, names in imports.items()}
    pairs = [f"{a} and {b}" for a, names in modules.items() for b in names if a < b and a in modules.get(b, ())]
    assert not pairs, "\n".join(pairs)
