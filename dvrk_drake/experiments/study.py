"""Schema and reader of study files, and cases of a study.

This file has no postponed annotations, because yaml_load_typed reads the types at run time.
"""

import dataclasses
import hashlib
import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from xml.etree.ElementTree import tostring

import numpy as np

from dvrk_drake.errors import DvrkDrakeError, StudyError
from dvrk_drake.experiments.scenario import Scenario, check_pose, load_scenario
from dvrk_drake.experiments.study_measures import Measure
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.ranges import number_fault, within
from dvrk_drake.models.sdf_model import compose_sdf
from dvrk_drake.models.typed_yaml import load_typed_yaml

#: Columns of the results, except those of the start pose and the measures.
RESERVED = ("study", "case", "variation", "pose", "seed", "error")


@dataclass
class RandomPoses:
    """Random poses, uniform in the joint box and inside the coupled limits, see `Arm.sample_poses`.

    Attributes:
        count: Number of poses.
        seed: Seed of the random numbers.
        margin: Minimum distance from the limits, as a share of each joint range.
    """

    count: int = field(default=0, metadata=within(1, 10**6))
    seed: int = field(default=0, metadata=within(0, 2**63 - 1))
    margin: float = field(default=0.0, metadata=within(0.0, 0.49))


@dataclass
class Variation:
    """Named variation of the scenario, given by settings "key=value"."""

    name: str = ""
    set: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Case:
    """One run of a study.

    Attributes:
        index: Number of the case, from 0.
        variation: Name of the variation.
        pose: Number of the start pose, from 0.
        seed: Seed of the scenario.
        start: Start pose (n,) [rad, m].
    """

    index: int
    variation: str
    pose: int
    seed: int
    start: tuple[float, ...]


@dataclass
class Study:
    """Schema of a study file: runs of a scenario for all combinations of poses, seeds and variations.

    Attributes:
        scenario: Name of an arm, or path of a scenario's YAML file, relative to the working directory.
        set: Settings "key=value" of the scenario, as for `dvrk-drake simulate --set`.
        poses: Start poses, one list of n numbers [rad, m] each. Default: the start of the scenario.
        random_poses: Random start poses, instead of `poses`.
        seeds: Seeds. The seed of a run is computed from one of these seeds and the number of the pose, so that runs of
            one variation are independent. All variations use the same seeds.
        variations: Variations of the scenario. Default: the unchanged scenario.
        measures: Measures that are computed for each run.
    """

    scenario: str = ""
    set: list[str] = field(default_factory=list)
    poses: list[list[float]] = field(default_factory=list, metadata=within(-1e4, 1e4, "rad or m"))
    random_poses: RandomPoses | None = None
    seeds: list[int] = field(default_factory=lambda: [0], metadata=within(0, 2**63 - 1))
    variations: list[Variation] = field(default_factory=lambda: [Variation("as stated")])
    measures: list[Measure] = field(default_factory=list)

    @cached_property
    def scenarios(self) -> dict[str, Scenario]:
        """Scenarios by variation, without the start poses and the seeds of the cases.

        Raises:
            ScenarioError: A setting of the scenario is invalid.
        """
        return {v.name: load_scenario(self.scenario, [*self.set, *v.set]) for v in self.variations}

    @property
    def arm(self) -> Arm:
        """Arm that is simulated."""
        return next(iter(self.scenarios.values())).mounted_arm

    @cached_property
    def cases(self) -> tuple[Case, ...]:
        """All cases, ordered by pose, so that an incomplete study contains all variations of its first poses."""
        starts = self._starts()
        runs = [(k, seed, v.name) for k in range(len(starts)) for seed in self.seeds for v in self.variations]
        return tuple(Case(i, v, k, _seed_of_run(seed, k), tuple(starts[k])) for i, (k, seed, v) in enumerate(runs))

    @cached_property
    def fingerprint(self) -> str:
        """Hash of all inputs of the study, including files and software versions."""
        content = {
            "versions": versions(),
            "scenarios": {name: dataclasses.asdict(scenario) for name, scenario in self.scenarios.items()},
            "models": [scenario.model.to_yaml() for scenario in self.scenarios.values()],
            "arms": [dataclasses.asdict(scenario.mounted_arm) for scenario in self.scenarios.values()],
            "sdf": [tostring(compose_sdf(scenario.mounted_arm.sdf), "unicode") for scenario in self.scenarios.values()],
            "cases": [dataclasses.astuple(case) for case in self.cases],
            "measures": [dataclasses.asdict(measure) for measure in self.measures],
        }
        text = json.dumps(content, default=lambda array: array.tolist())
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def scenario_of(self, case: Case) -> Scenario:
        """Returns the scenario of a case. `dvrk-drake simulate` can repeat the case with this scenario."""
        scenario = self.scenarios[case.variation]
        controller = scenario.controller
        if controller.model:  # workers may use another working directory
            controller = dataclasses.replace(controller, model=os.path.realpath(controller.model))
        arm = scenario.mounted_arm.source
        return dataclasses.replace(scenario, arm=arm, controller=controller, start=list(case.start), seed=case.seed)

    def check(self) -> None:
        """Checks that all cases are valid.

        Raises:
            StudyError: A field is invalid. The message gives the field, its value, and the accepted values.
            ScenarioError, ArmError, ModelError: The scenario is invalid for a variation or a pose.
        """
        if not self.scenario:
            raise StudyError("scenario is missing. Give the name of an arm, or the path of a scenario's YAML file.")
        if not (self.seeds and self.variations and self.measures):
            raise StudyError("seeds, variations and measures must not be empty")
        if fault := number_fault(self):
            raise StudyError(fault)
        if len({*self.seeds}) < len(self.seeds):
            raise StudyError(f"seeds must not contain a number twice; got {self.seeds}")
        _check_names("variations", [variation.name for variation in self.variations])
        if any(scenario.mounted_arm.joint_names != self.arm.joint_names for scenario in self.scenarios.values()):
            raise StudyError("all variations must have the same joints")
        for i, measure in enumerate(self.measures):
            for scenario in self.scenarios.values():
                try:
                    measure.check(scenario)
                except StudyError as error:
                    raise StudyError(f"measures[{i}].{error}") from error
        _check_names("measures", [measure.column for measure in self.measures])
        reserved = ", ".join([*RESERVED, "q1, q2, ..."])
        for column in (measure.column for measure in self.measures):
            if column in RESERVED or not re.fullmatch(r"[A-Za-z_]\w*", column) or re.fullmatch(r"q\d+", column):
                raise StudyError(
                    f'measures: "{column}" cannot be a column; allowed: letters, digits and "_", except {reserved}'
                )
        self._check_poses()

    def _check_poses(self) -> None:
        for k, pose in enumerate(self.poses):
            for scenario in self.scenarios.values():
                check_pose(f"poses[{k}]", pose, scenario.mounted_arm)
        if self.random_poses is None:
            return
        if self.poses:
            raise StudyError("poses and random_poses exclude each other. Remove one of them.")

    def _starts(self) -> list[list[float]]:
        """Returns the start poses of the arm."""
        if self.random_poses is not None:
            random = self.random_poses
            return self.arm.sample_poses(random.count, np.random.default_rng(random.seed), random.margin).tolist()
        if self.poses:
            return self.poses
        return next(iter(self.scenarios.values())).knots()[1][:1].tolist()


def load_study(path: str | Path, settings: Sequence[str] = ()) -> Study:
    """Reads a study file, adds settings "key=value" for the scenario of the study, and checks the study.

    Raises:
        StudyError: The file cannot be read, has an unknown key, or has an invalid value.
    """
    study = load_typed_yaml(Study, path, StudyError, "a study")
    study.set = [*study.set, *settings]
    try:
        study.check()
    except DvrkDrakeError as error:
        raise StudyError(f"{path}: {error}") from error
    return study


def versions() -> dict[str, str]:
    """Returns the versions of the packages that the results depend on, by name."""
    return {package: version(package) for package in ("dvrk-drake", "drake", "numpy")}


def _seed_of_run(seed: int, pose: int) -> int:
    return int(np.random.SeedSequence([seed, pose]).generate_state(1)[0])


def _check_names(what: str, names: list[str]) -> None:
    if len({*names}) < len(names) or not all(name.isprintable() and name for name in names):
        raise StudyError(f"{what} must have different names of one line each; got {names}")
