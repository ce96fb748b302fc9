"""The studies by name."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

from msgspec.structs import replace

from skyless.research.studies import (
    efficiency,
    integrity,
    large,
    loss,
    motion,
    nlos,
    phase,
    room,
    scale,
    survey,
    survey_room,
    sync,
    watch,
)
from skyless.research.studies.common.picture import Look, draw
from skyless.research.studies.common.plan import Cell, Plan, Row, Study
from skyless.research.studies.common.summary import Case, world_cells, world_rows


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
            _of_worlds("loss", "lost messages", loss.cases, Look("Lost messages", ("rmse", "nees"), x="share lost")),
            cells=loss.cells,
            rows=loss.rows,
        ),
        _of_worlds("nlos", "late messages", nlos.cases, Look("Late messages", ("rmse", "nees"))),
        _of_worlds("motion", "motion", motion.cases, Look("Speed and turns at 3 m/s²", ("rmse", "nees"))),
        _of_worlds(
            "sync",
            "synchronisation",
            sync.cases,
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
        _of_worlds("scale", "numbers of tags and anchors", scale.cases, Look("Scale", ("rmse", "cpu"), log=True)),
    )
}
