"""Reads a scenario from its file and the command line, strictly."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_dump, yaml_load, yaml_load_typed

from dvrk_drake.analysis.simulation.scenario import ControllerScenario, HandScenario, Scenario, Target
from dvrk_drake.errors import ScenarioError
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.models.effects_schema import Cable, DriveEffect
from dvrk_drake.models.gains_file import load_gains


def load_scenario(arm_or_file: str, settings: Sequence[str] = ()) -> Scenario:
    """Reads a scenario file, or makes the scenario of an arm that holds its home pose; changes it, and checks it.

    Args:
        arm_or_file: path of a YAML file, or the name of an arm.
        settings: "key=value" in YAML; a dot goes into a group: "controller.mode=gravity", "targets=[...]".

    Raises:
        ScenarioError: the file cannot be read, has an unknown key, or asks for what makes no sense.
    """
    path = Path(arm_or_file)
    if path.suffix in (".yaml", ".yml"):
        if not path.is_file():
            raise ScenarioError(f"{path}: no such scenario file")
        try:
            content = _parse(path.read_text(encoding="utf-8"), str(path))
        except (OSError, UnicodeDecodeError) as error:
            raise ScenarioError(f"{path}: not a text file in UTF-8: {error}") from error
        if not isinstance(content, dict):
            raise ScenarioError(f"{path}: must be keys and values; {_known_keys()}")
        if "mechanism" in content:
            raise ScenarioError(f"{path}: is an arm's file, not a scenario; give an arm's name and --set arm={path}")
    else:
        content = {"arm": arm_or_file}
    for setting in settings:
        _change(content, setting)
    _load_gains_of(content)
    for key, value in content.items():
        try:
            yaml_load_typed(schema=Scenario, data=yaml_dump({key: value}))
        except Exception as error:
            # yaml_load_typed raises many types, from RuntimeError to TypeError, and does not always name the key.
            raise ScenarioError(f"{arm_or_file}: {key}: {error}; {_known_keys()}") from error
    scenario = yaml_load_typed(schema=Scenario, data=yaml_dump(content))
    try:
        scenario.check()
    except ScenarioError as error:
        raise ScenarioError(f"{arm_or_file}: {error}") from error
    return scenario


def _load_gains_of(content: dict[str, Any]) -> None:
    """Puts what is in a file of gains in the place of its name."""
    controller = content.get("controller")
    if isinstance(controller, dict) and isinstance(controller.get("gains"), str):
        controller["gains"] = dataclasses.asdict(load_gains(controller["gains"]))


def _change(content: dict[str, Any], setting: str) -> None:
    key, equals, value = setting.partition("=")
    if not equals or not key:
        raise ScenarioError(f'--set {setting}: must be key=value, e.g. "duration=2" or "controller.mode=gravity"')
    *groups, last = key.strip().split(".")
    group: Any = content
    for name in groups:
        group = group.setdefault(name, {})
        if not isinstance(group, dict):
            raise ScenarioError(f"--set {setting}: {name} has no keys of its own; {_known_keys()}")
    group[last] = _parse(value, f"--set {setting}")


def _parse(text: str, where: str) -> Any:
    try:
        return yaml_load(data=text)
    except Exception as error:
        raise ScenarioError(f"{where}: not YAML: {error}") from error


def _known_keys() -> str:
    def names(schema: type) -> str:
        return ", ".join(f.name for f in dataclasses.fields(schema))

    groups = {
        "controller": ControllerScenario,
        "controller.gains": Gains,
        "targets": Target,
        "effects": DriveEffect,
        "stretch.<actuator>": Cable,
        "hand": HandScenario,
    }
    return f"allowed: {names(Scenario)}; " + "; ".join(f"in {key}: {names(schema)}" for key, schema in groups.items())
