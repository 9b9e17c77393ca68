"""Reproduces the requested figures and tables, and writes a page with the results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.experiments.reproduction.published import PaperRecordings
from dvrk_drake.experiments.reproduction.session import ReproductionSession, SampleSizes
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.reports.provenance import Provenance
from dvrk_drake.reports.reproduction.drift import reproduce_figure_5, reproduce_figure_6
from dvrk_drake.reports.reproduction.mechanisms import reproduce_psm, reproduce_table_1
from dvrk_drake.reports.reproduction.page import Section, write_page
from dvrk_drake.reports.reproduction.step_response import reproduce_figure_7
from dvrk_drake.reports.reproduction.torque_errors import reproduce_figure_4
from dvrk_drake.reports.reproduction.transparency import reproduce_transparency
from dvrk_drake.workers import local_executor

_MAKERS: dict[str, Callable[[ReproductionSession], Section]] = {
    "table1": lambda session: reproduce_table_1(),
    "fig4": lambda session: reproduce_figure_4(session.recordings, step_progress(session.progress, "identifying")),
    "fig5": reproduce_figure_5,
    "fig6": reproduce_figure_6,
    "fig7": reproduce_figure_7,
    "psm": reproduce_psm,
    "transparency": reproduce_transparency,
}
#: Names of all sections, in the order of the page.
NAMES = tuple(_MAKERS)


def reproduce(
    names: Sequence[str],
    folder: Path,
    recordings: PaperRecordings,
    progress: Progress = lambda step, share: None,
    sample_sizes: SampleSizes | None = None,
    seed: int = 0,
    command: Sequence[str] = (),
) -> tuple[Path, list[Section]]:
    """Writes figures, tables and index.html. The function writes index.html again after each finished section.

    Args:
        names: Sections to reproduce, from `NAMES`.
        folder: Existing folder for the results.
        recordings: Recordings of the paper. Without them, Fig. 4 is omitted if other sections are requested, and
            Fig. 5 and 6 use a different ground-truth arm.
        progress: Function called with a step, for example "fig5: releasing", and the finished share of this step (0
            to 1).
        sample_sizes: Numbers of poses and releases. None: the default numbers.
        seed: Seed of ground-truth arms, poses and noise.
        command: Words of the command line, for the provenance.

    Returns:
        Path of index.html, and the finished sections.

    Raises:
        DvrkDrakeError: A name is not in `NAMES`.
        RecordingError: A recording cannot be read, or only Fig. 4 is requested and its recording is missing.
    """
    if unknown := sorted(set(names) - set(NAMES)):
        raise DvrkDrakeError(f"{', '.join(unknown)} cannot be reproduced; allowed: {', '.join(NAMES)}")
    wanted = [name for name in NAMES if name in names]
    left_out = []
    if recordings.folder is None and "fig4" in wanted and len(wanted) > 1:
        wanted.remove("fig4")
        left_out.append("Fig. 4 requires the recording of the paper. Give its folder with --data.")
    with local_executor() as executor:
        session = ReproductionSession(
            folder, recordings, executor, sample_sizes=sample_sizes or SampleSizes(), seed=seed
        )
        sections: list[Section] = []
        for name in wanted:
            progress(name, 0.0)
            session.progress = _within(progress, name)
            sections.append(_MAKERS[name](session))
            unfinished = [f"{later} was not finished." for later in wanted[len(sections) :]]
            page = write_page(folder, sections, [*left_out, *unfinished], Provenance.of(recordings.files, command))
    return page, sections


def _within(progress: Progress, name: str) -> Progress:
    return lambda step, share: progress(f"{name}: {step}", share)
