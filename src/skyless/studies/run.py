"""All of ``skyless study`` but for what it writes."""

from collections.abc import Callable
from typing import Final

from skyless.errors import SkylessError
from skyless.studies.common.plan import Plan, Row, Study
from skyless.studies.common.runner import run_cells, run_cells_here, run_cells_on_dask

OF_EPISODES: Final = ("efficiency", "integrity")
"""Studies of the filter ``joint`` itself."""

WITHOUT_POSITIONS: Final = ("claims", "watch")
"""Studies in which nobody computes positions."""


def check_amounts(
    name: str,
    *,
    episodes: int | None,
    worlds: int | None,
    seconds: float | None,
    noise_ps: float | None,
    qa: float | None,
    dynamics: str | None,
    integrity_risk: float | None,
    alert_limit_m: float | None,
) -> None:
    """See that the study of that name takes what is given. Raises SkylessError."""
    if name != "integrity" and (integrity_risk is not None or alert_limit_m is not None):
        raise SkylessError("--integrity-risk and --alert-limit-m are for the study integrity")
    if name not in OF_EPISODES and episodes is not None:
        takes = f"{name} takes --worlds and --seconds"
        raise SkylessError(f"--episodes is for the studies efficiency and integrity; {takes}")
    others = {"worlds": worlds, "seconds": seconds, "noise-ps": noise_ps, "qa": qa, "dynamics": dynamics}
    given = [option for option, value in others.items() if value is not None]
    unfit = [option for option in given if option in {"worlds", "seconds"}]
    if name == "integrity" and unfit:
        raise SkylessError(f"--{unfit[0]} is not for the study integrity; give --episodes")
    if name == "efficiency" and given:
        raise SkylessError(f"--{given[0]} is not for the study efficiency, which has cases of its own; give --episodes")


def run_study(
    chosen: Study,
    plan: Plan,
    on_progress: Callable[[float], None],
    processes: int | None = None,
    scheduler: str | None = None,
) -> list[Row]:
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
