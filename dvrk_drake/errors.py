"""Errors that a user can correct. Each message states the problem, its location and the accepted values."""

from __future__ import annotations


class DvrkDrakeError(Exception):
    """Base class of all errors that this package raises deliberately.

    For these errors, the command line exits with code 2.

    Attributes:
        findings: Findings of `check` for the recording that caused the error, or an empty tuple if there are none.
            `str(finding)` is a text of one line.

    Example:
        >>> import dvrk_drake as dvrk
        >>> try:
        ...     dvrk.load_arm("mtmx")
        ... except dvrk.DvrkDrakeError as error:
        ...     print(str(error).partition(",")[0])
        unknown arm "mtmx"; known arms: ecm
    """

    findings: tuple[object, ...] = ()


class ArmError(DvrkDrakeError):
    """Error for an arm that does not exist, or whose files contradict each other."""


class RecordingError(DvrkDrakeError):
    """Error for a recording that cannot be read or used."""


class ModelError(DvrkDrakeError):
    """Error for an identified model that cannot be read, or does not match the arm or data that it is used with."""


class IdentificationError(DvrkDrakeError):
    """Error for a recording that does not determine the requested quantities."""


class ControllerError(DvrkDrakeError):
    """Error for settings that a controller cannot use, or for an arm that it cannot control."""


class KeyFileError(DvrkDrakeError):
    """Error for an authentication key that cannot be read, created or used."""


class StationError(DvrkDrakeError):
    """Error for a station that cannot be built or used as requested."""


class ScenarioError(DvrkDrakeError):
    """Error for a scenario that cannot be read or simulated."""


class SimulationError(DvrkDrakeError):
    """Error for a simulation that diverged, or whose solver failed."""


class CollectionError(DvrkDrakeError):
    """Error for poses that the arm cannot reach, or for a run of `collect` that cannot be started or continued."""


class ExcitationError(DvrkDrakeError):
    """Error for a motion file, or for limits that no motion of the arm can meet."""


class StudyError(DvrkDrakeError):
    """Error for a study that cannot be read, run or resumed."""
