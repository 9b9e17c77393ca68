"""Reads a scenario from its file and the command line, strictly."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dvrk_drake.errors import ScenarioError
from dvrk_drake.experiments.scenario import Scenario
from dvrk_drake.models.gains_file import load_gains
from dvrk_drake.models.typed_yaml import load_yaml, parse_yaml, typed_content


def load_scenario(arm_or_file: str, settings: Sequence[str] = ()) -> Scenario:
    """Reads a scenario file, or makes the scenario of an arm that holds its home pose; changes it, and checks it.

    Args:
        arm_or_file: path of a YAML file, or the name of an arm.
        settings: "key=value" in YAML; a dot goes into a group: "controller.mode=gravity", "targets=[...]".

    Raises:
        ScenarioError: the file cannot be read, has an unknown key, or asks for what makes no sense.

    Example:
        >>> import dvrk_drake as dvrk
        >>> scenario = dvrk.load_scenario("mtml", ["duration=2", "controller.mode=damped"])
        >>> scenario.duration, scenario.controller.mode
        (2.0, 'damped')
    """
    path = Path(arm_or_file)
    if path.suffix in (".yaml", ".yml"):
        content = load_yaml(path, ScenarioError)
        if isinstance(content, dict) and "mechanism" in content:
            raise ScenarioError(f"{path}: is an arm's file, not a scenario; give an arm's name and --set arm={path}")
    else:
        content = {"arm": arm_or_file}
    if isinstance(content, dict):
        for setting in settings:
            _change(content, setting)
        _load_gains_of(content)
    scenario = typed_content(Scenario, content, arm_or_file, ScenarioError, "a scenario")
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
            raise ScenarioError(f"--set {setting}: {name} has no keys of its own")
    group[last] = parse_yaml(value, f"--set {setting}", ScenarioError)
