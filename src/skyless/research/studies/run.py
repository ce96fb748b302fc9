"""The studies by name, and how one is run."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.research.studies import efficiency, integrity, large, room, survey, surveyed_rooms, watch
from skyless.research.studies.runner import KeptResults, Plan, Row, Study, UnfinishedError, run_cells

OF_EPISODES: Final = ("efficiency", "integrity")
"""Studies of episodes, which have no worlds."""


class Parts(Struct, frozen=True):
    """How many cells of a study were computed, and how many resumed."""

    computed: int
    resumed: int
    """From the folder of an earlier call."""
    damaged: tuple[str, ...]
    """Files of that folder whose parts were computed again."""


def run_study(
    chosen: Study,
    plan: Plan,
    on_progress: Callable[[float], None],
    processes: int | None = None,
    resume: str | Path | None = None,
) -> tuple[Sequence[Row], Parts]:
    """The rows of a study; ``on_progress`` gets the share done. One process is this one.

    Finished cells are kept in the folder ``resume``, and those that are there are not computed.

    Raises SkylessError: a process died, or the folder cannot be used.
    """
    cells = chosen.cells(plan)
    kept = None if resume is None else KeptResults(resume, chosen.name, plan)
    results, damaged = ({}, ()) if kept is None else kept.read(len(cells))
    parts = Parts(len(cells) - len(results), len(results), damaged)
    numbers = [number for number in range(len(cells)) if number not in results]
    missing = [cells[number] for number in numbers]

    def finished(index: int, result: object) -> None:
        results[numbers[index]] = result
        if kept is not None:
            kept.keep(numbers[index], result)

    try:
        run_cells(missing, on_progress, processes, finished)
    except UnfinishedError as error:
        raise SkylessError(f"{error}; {way_on(resume)}") from None
    return chosen.rows(plan, [results[number] for number in range(len(cells))]), parts


def way_on(resume: str | Path | None) -> str:
    """Advice for going on after a study has ended early."""
    if resume is None:
        return "nothing was written; --resume FOLDER keeps what is finished"
    return f"the same command with --resume {resume} goes on"


# The studies by name.


def _study(name: str, title: str, module: Any, *panels: str, x: str = "") -> Study:  # noqa: ANN401 - a module
    return Study(name, title, module.cells, module.rows, panels, x)


STUDIES: Final = {
    study.name: study
    for study in (
        _study("efficiency", "RMSE over the Cramér–Rao bound", efficiency, "ratio", "nees"),
        _study(
            "integrity",
            "protection levels with one faulty anchor",
            integrity,
            *("hpl", "available", "misleading"),
            x="size of the fault in m",
        ),
        _study("room", "the room", room, "rmse", "nees", "level", "exceeded"),
        _study("large", "a site of 1,024 anchors without a master", large, "rmse", "nees"),
        _study("survey", "anchors that survey themselves", survey, "rmse", "nees"),
        _study("survey-room", "tags by surveyed anchors", surveyed_rooms, "rmse", "nees"),
        _study("watch", "the watch of the anchors", watch, "found", "found_s"),
    )
}
