"""Public methods of Systems have Drake-style names (`SetGains`), other classes Python-style names (`load_arm`)."""

import ast

from repository import ROOT

SYSTEMS = {"LeafSystem", "Diagram"}
#: Methods that override those of Drake.
OF_DRAKE = {"Serialize", "Deserialize"}


def public_methods():
    """Returns (location, flag of a System, name) of each public method that is not a property."""
    for path in sorted((ROOT / "dvrk_drake").rglob("*.py")):
        if "lcmtypes" in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                is_system = any(isinstance(base, ast.Name) and base.id in SYSTEMS for base in node.bases)
                for method in node.body:
                    if isinstance(method, ast.FunctionDef) and not method.name.startswith("_"):
                        names = {d.id for d in method.decorator_list if isinstance(d, ast.Name)}
                        if not names & {"property", "cached_property"}:
                            yield f"{path.name}: {node.name}.{method.name}", is_system, method.name


def test_method_names_follow_the_style():
    methods = list(public_methods())
    assert sum(is_system for _, is_system, _ in methods) > 10
    wrong = [where for where, is_system, name in methods if name[0].isupper() != is_system and name not in OF_DRAKE]
    assert not wrong, wrong
