"""All of ``skyless study`` but for what it writes."""

from collections.abc import Callable, Sequence
from typing import Final

from skyless.research.studies.common.plan import Plan, Row, Study
from skyless.research.studies.common.runner import run_cells, run_cells_here, run_cells_on_dask

OF_EPISODES: Final = ("efficiency", "integrity")
"""Studies of the filter ``joint`` itself."""

WITHOUT_POSITIONS: Final = ("watch",)
"""Studies in which nobody computes positions."""


def run_study(
    chosen: Study,
    plan: Plan,
    on_progress: Callable[[float], None],
    processes: int | None = None,
    scheduler: str | None = None,
) -> Sequence[Row]:
    """The rows of a study; ``on_progress`` gets the share done. One process is this one.

    Raises:
        SkylessError: a process died, or the Dask scheduler cannot be used.
    """
    cells = chosen.cells(plan)
    if scheduler is None and processes == 1:
        results = run_cells_here(cells, on_progress)
    elif scheduler is None:
        results = run_cells(cells, on_progress, processes)
    else:
        results = run_cells_on_dask(cells, on_progress, scheduler)
    return chosen.rows(plan, results)
