"""Errors that a user can act on: each message says what is wrong, where, and what is allowed."""

from __future__ import annotations


class DvrkDrakeError(Exception):
    """Base of every error that this package raises on purpose; the command line turns it into exit code 2.

    Attributes:
        findings: what `check` found in the recording that the error is about; `str` of each is one line.

    Example:
        >>> import dvrk_drake as dvrk
        >>> try:
        ...     dvrk.load_arm("mtmx")
        ... except dvrk.DvrkDrakeError as error:
        ...     print(error)
        unknown arm "mtmx"; known arms: mtml, mtmr, psm; or name a YAML file
    """

    findings: tuple[object, ...] = ()


class ArmError(DvrkDrakeError):
    """An arm that does not exist, or whose files contradict each other."""


class RecordingError(DvrkDrakeError):
    """A recording that cannot be read or used."""


class ModelError(DvrkDrakeError):
    """An identified model that cannot be read, or does not fit what it is used with."""


class IdentificationError(DvrkDrakeError):
    """A recording that does not determine what was asked of it."""


class ControllerError(DvrkDrakeError):
    """A controller that was given gains, limits or a period that it cannot run with."""


class KeyFileError(DvrkDrakeError):
    """A key for the authentication of messages that cannot be read, made or used."""


class StationError(DvrkDrakeError):
    """A station that cannot be built or used as asked."""


class ScenarioError(DvrkDrakeError):
    """A scenario that cannot be read or simulated."""


class CollectionError(DvrkDrakeError):
    """Poses that cannot be visited, or a collection of measurements that cannot go on."""


class StudyError(DvrkDrakeError):
    """A study that cannot be read, run or gone on with."""
