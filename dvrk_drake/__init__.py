"""Models, identification, gravity compensation and simulation of da Vinci Research Kit arms with Drake.

The public API consists of the names in `__all__`, such as `load_arm` and `identify`. Each module is imported when one
of its names is first used, because importing drake and numba takes seconds.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dvrk_drake.analysis.check.recording_check import check
    from dvrk_drake.analysis.excitation.design import design_excitation
    from dvrk_drake.analysis.excitation.motion_limits import MotionLimits
    from dvrk_drake.analysis.excitation.periodic_motion import PeriodicMotion
    from dvrk_drake.analysis.excitation.static_poses import design_poses
    from dvrk_drake.analysis.external_force import estimate_force
    from dvrk_drake.analysis.identification import identify
    from dvrk_drake.analysis.payload import payload
    from dvrk_drake.analysis.recalibration import recalibrate
    from dvrk_drake.analysis.validation import predict, validate
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.dynamics.kinematics import Contact, inverse_kinematics
    from dvrk_drake.errors import DvrkDrakeError
    from dvrk_drake.experiments.ground_truth import perturbed_arm, simulate_poses
    from dvrk_drake.experiments.scenario import Scenario, load_scenario
    from dvrk_drake.experiments.simulation import simulate
    from dvrk_drake.export.model_export import export_model
    from dvrk_drake.models.arm import Arm
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.models.environment import Environment
    from dvrk_drake.models.locked_joints import lock_joints
    from dvrk_drake.models.plant import add_arm, set_arm_positions
    from dvrk_drake.processes.arm_session import Dialog
    from dvrk_drake.processes.calibration import calibrate
    from dvrk_drake.processes.collector import CollectionSettings
    from dvrk_drake.processes.connection import ArmConnection, connect
    from dvrk_drake.recordings.formats import read_recording, write_recording, write_samples
    from dvrk_drake.recordings.recording import Recording
    from dvrk_drake.reports.html_file import write_report
    from dvrk_drake.systems.arm_drive import add_arm_drive
    from dvrk_drake.systems.arm_effects.dry_friction import PlantEffects
    from dvrk_drake.systems.arm_station import ArmStation
    from dvrk_drake.systems.arm_view.page import start_meshcat
    from dvrk_drake.systems.closed_loop import add_closed_loop
    from dvrk_drake.systems.driver import CrtkDriver, DvrkDriver
    from dvrk_drake.systems.external_force_estimator import ExternalForceEstimator
    from dvrk_drake.systems.force_feedback import ForceFeedback
    from dvrk_drake.systems.gravity_pid_controller import GravityPidController
    from dvrk_drake.systems.hardware_arm_station import HardwareArmStation
    from dvrk_drake.systems.station import Station, load_station_config
    from dvrk_drake.systems.teleoperated_arms import TeleoperatedArms, Wall

#: Mapping from a public name to the module that defines it.
_MODULES = {
    "Arm": "models.arm",
    "ArmConnection": "processes.connection",
    "ArmStation": "systems.arm_station",
    "CollectionSettings": "processes.collector",
    "Contact": "dynamics.kinematics",
    "CrtkDriver": "systems.driver",
    "Dialog": "processes.arm_session",
    "DvrkDrakeError": "errors",
    "DvrkDriver": "systems.driver",
    "Environment": "models.environment",
    "ExternalForceEstimator": "systems.external_force_estimator",
    "ForceFeedback": "systems.force_feedback",
    "GravityPidController": "systems.gravity_pid_controller",
    "HardwareArmStation": "systems.hardware_arm_station",
    "IdentifiedModel": "dynamics.identified_model",
    "MotionLimits": "analysis.excitation.motion_limits",
    "PeriodicMotion": "analysis.excitation.periodic_motion",
    "PlantEffects": "systems.arm_effects.dry_friction",
    "Recording": "recordings.recording",
    "Scenario": "experiments.scenario",
    "Station": "systems.station",
    "TeleoperatedArms": "systems.teleoperated_arms",
    "Wall": "systems.teleoperated_arms",
    "add_arm": "models.plant",
    "add_arm_drive": "systems.arm_drive",
    "add_closed_loop": "systems.closed_loop",
    "calibrate": "processes.calibration",
    "check": "analysis.check.recording_check",
    "connect": "processes.connection",
    "design_excitation": "analysis.excitation.design",
    "design_poses": "analysis.excitation.static_poses",
    "estimate_force": "analysis.external_force",
    "export_model": "export.model_export",
    "identify": "analysis.identification",
    "inverse_kinematics": "dynamics.kinematics",
    "load_arm": "models.arm_files",
    "lock_joints": "models.locked_joints",
    "load_scenario": "experiments.scenario",
    "load_station_config": "systems.station",
    "payload": "analysis.payload",
    "perturbed_arm": "experiments.ground_truth",
    "predict": "analysis.validation",
    "read_recording": "recordings.formats",
    "recalibrate": "analysis.recalibration",
    "set_arm_positions": "models.plant",
    "simulate": "experiments.simulation",
    "simulate_poses": "experiments.ground_truth",
    "start_meshcat": "systems.arm_view.page",
    "validate": "analysis.validation",
    "write_recording": "recordings.formats",
    "write_report": "reports.html_file",
    "write_samples": "recordings.formats",
}

__all__ = [
    "Arm",
    "ArmConnection",
    "ArmStation",
    "CollectionSettings",
    "Contact",
    "CrtkDriver",
    "Dialog",
    "DvrkDrakeError",
    "DvrkDriver",
    "Environment",
    "ExternalForceEstimator",
    "ForceFeedback",
    "GravityPidController",
    "HardwareArmStation",
    "IdentifiedModel",
    "MotionLimits",
    "PeriodicMotion",
    "PlantEffects",
    "Recording",
    "Scenario",
    "Station",
    "TeleoperatedArms",
    "Wall",
    "add_arm",
    "add_arm_drive",
    "add_closed_loop",
    "calibrate",
    "check",
    "connect",
    "design_excitation",
    "design_poses",
    "estimate_force",
    "export_model",
    "identify",
    "inverse_kinematics",
    "load_arm",
    "load_scenario",
    "load_station_config",
    "lock_joints",
    "payload",
    "perturbed_arm",
    "predict",
    "read_recording",
    "recalibrate",
    "set_arm_positions",
    "simulate",
    "simulate_poses",
    "start_meshcat",
    "validate",
    "write_recording",
    "write_report",
    "write_samples",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
