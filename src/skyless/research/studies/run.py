"""The studies by name, and how one is run."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.errors import SkylessError
from skyless.research.studies import efficiency, integrity, lab, large, phase, room, survey, survey_room, watch
from skyless.research.studies.picture import Case, Look, draw, world_cells, world_rows
from skyless.research.studies.runner import (
    Cell,
    KeptResults,
    Plan,
    Row,
    Study,
    UnfinishedError,
    run_cells,
    run_cells_here,
    run_cells_on_dask,
)

OF_EPISODES: Final = ("efficiency", "integrity")
"""Studies of the filter ``joint`` itself."""

WITHOUT_POSITIONS: Final = ("watch",)
"""Studies in which nobody computes positions."""


class Parts(Struct, frozen=True):
    """Where the results of a study's cells came from."""

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
    scheduler: str | None = None,
    resume: str | Path | None = None,
) -> tuple[Sequence[Row], Parts]:
    """The rows of a study; ``on_progress`` gets the share done. One process is this one.

    Finished cells are kept in the folder ``resume``, and those that are there are not computed.

    Raises:
        SkylessError: a process died, or the Dask scheduler or the folder cannot be used.
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
        if processes == 1 or not missing:
            run_cells_here(missing, on_progress, finished)
        elif scheduler is None:
            run_cells(missing, on_progress, processes, finished)
        else:
            run_cells_on_dask(missing, on_progress, scheduler, finished)
    except UnfinishedError as error:
        raise SkylessError(f"{error}; {way_on(resume)}") from None
    return chosen.rows(plan, [results[number] for number in range(len(cells))]), parts


def way_on(resume: str | Path | None) -> str:
    """What to do after a study has ended early."""
    if resume is None:
        return "nothing was written; --resume FOLDER keeps what is finished"
    return f"the same command with --resume {resume} goes on"


# The studies by name.


def _of_worlds(name: str, title: str, cases: Callable[[Plan], list[Case]], look: Look) -> Study:
    def cells(plan: Plan) -> list[Cell]:
        return world_cells(cases(plan))

    def rows(plan: Plan, results: Sequence[Any]) -> Sequence[Row]:
        return world_rows(name, plan, cases(plan), results)

    return Study(name, title, cells, rows, partial(draw, look))


STUDIES: Final = {
    study.name: study
    for study in (
        Study(
            "efficiency",
            "RMSE over the Cramér–Rao bound",
            efficiency.cells,
            efficiency.rows,
            partial(draw, Look("RMSE over the Cramér–Rao bound", ("ratio", "nees"))),
        ),
        replace(
            _of_worlds(
                "loss", "lost messages", lab.loss_cases, Look("Lost messages", ("rmse", "nees"), x="share lost")
            ),
            cells=lab.loss_cells,
            rows=lab.loss_rows,
        ),
        _of_worlds("nlos", "late messages", lab.nlos_cases, Look("Late messages", ("rmse", "nees"))),
        _of_worlds("motion", "motion", lab.motion_cases, Look("Speed and turns at 3 m/s²", ("rmse", "nees"))),
        _of_worlds(
            "sync",
            "synchronisation",
            lab.sync_cases,
            Look("Synchronisation", ("rmse", "nees"), x="superframe in ms", log=True),
        ),
        Study(
            "integrity",
            "protection levels with one faulty anchor",
            integrity.cells,
            integrity.rows,
            partial(
                draw,
                Look("One faulty anchor", ("hpl", "available", "misleading"), x="size of the fault in m", log=True),
            ),
        ),
        replace(
            _of_worlds("room", "the room", room.cases, Look("The room", ("rmse", "nees", "level", "exceeded"))),
            cells=room.cells,
            rows=room.rows,
        ),
        replace(
            _of_worlds("phase", "phases of the carrier", phase.cases, Look("Phases of the carrier", ("rmse", "nees"))),
            rows=phase.rows,
        ),
        Study(
            "large",
            "a site of 1,024 anchors without a master",
            large.cells,
            large.rows,
            partial(draw, Look("1,024 anchors, no master", ("rmse", "nees"))),
        ),
        Study(
            "survey",
            "anchors that survey themselves",
            survey.cells,
            survey.rows,
            partial(draw, Look("Anchors that survey themselves", ("rmse", "nees"))),
        ),
        Study(
            "survey-room",
            "tags by surveyed anchors",
            survey_room.cells,
            survey_room.rows,
            partial(draw, Look("Tags by surveyed anchors", ("rmse", "nees"))),
        ),
        Study(
            "watch",
            "the watch of the anchors",
            watch.cells,
            watch.rows,
            partial(draw, Look("The watch of the anchors", ("found", "found_s"))),
        ),
        _of_worlds("scale", "numbers of tags and anchors", large.scale_cases, Look("Scale", ("rmse", "cpu"), log=True)),
    )
}
