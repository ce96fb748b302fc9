"""``skyless study``: how the receiver does under what, over many runs in the simulated world."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.cli.common.options import IntegrityRisk, Picoseconds, Positive, integrity_of, known_method
from skyless.cli.common.progress import progress_bar, status
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from skyless.studies.plan import Plan, Row, Study

_Name = Literal["efficiency", "loss", "nlos", "motion", "sync", "integrity", "room", "scale"]
_Count = Annotated[int, Parameter(validator=Number(gte=1, lte=10**6))]

_USUAL_METHOD = "joint"

_OF_EPISODES = ("efficiency", "integrity")
"""Studies of the filter ``joint`` itself."""

app = App(name="study", help_epilogue="Example: skyless study loss --seed 7 --plot loss.png")


@app.default
def study(
    name: _Name,
    /,
    *,
    method: str | None = None,
    seed: Annotated[int, Parameter(validator=Number(gte=0))] = 1,
    episodes: _Count | None = None,
    worlds: Annotated[int, Parameter(validator=Number(gte=2, lte=10**5))] | None = None,
    seconds: Annotated[float, Parameter(validator=Number(gte=1, lte=1e6))] | None = None,
    noise_ps: Picoseconds | None = None,
    qa: Positive | None = None,
    integrity_risk: IntegrityRisk | None = None,
    alert_limit_m: Positive | None = None,
    without_mesh: bool = False,
    quick: bool = False,
    json: bool = False,
    plot: Path | None = None,
    out: Path | None = None,
    scheduler: str | None = None,
    processes: Annotated[int, Parameter(validator=Number(gte=1, lte=1024))] | None = None,
) -> None:
    """Measure errors over many simulated runs: a table with standard errors, a picture, JSON.

    Parameters
    ----------
    name
        efficiency: RMSE over the Cramér–Rao bound. loss: lost messages. nlos: late ones. motion: speed and turns.
        sync: masters that die, superframes, crystals. integrity: protection levels with a faulty anchor.
        room: the errors of real rooms, and what goes wrong in them. scale: numbers of tags and anchors.
    method
        A positioning method, by default the best one.
    seed
        Same seed, same rows, whatever computes them; CPU times apart.
    episodes
        Episodes of two seconds for each case (efficiency, integrity).
    worlds
        Independent worlds for each case (all others, but for the tags of scale; room: a quarter but for its first).
    seconds
        Simulated seconds for which each world is judged.
    noise_ps
        Noise of every TX and RX stamp in picoseconds, known to the filters; by default 100.
    qa
        Agility that the filters assume at rest, m²/s³; by default 0.3.
    integrity_risk
        Probability, for each fix, that the error exceeds its protection level (integrity); 1e-4 by default.
    alert_limit_m
        Fixes with a higher protection level than so many metres count as not available (integrity).
    without_mesh
        Anchors relay only when they heard the master.
    quick
        Simulate a fraction, with more scatter.
    json
        Write one JSON object instead of the table.
    plot
        Draw the picture into this file.
    out
        Write the rows as JSON and CSV and the picture as PNG and SVG into this folder.
    scheduler
        Address of a Dask scheduler whose workers do the work, for example tcp://127.0.0.1:8786.
    processes
        Processes on this machine; by default one for each core.
    """
    from skyless.cli.study_output import print_rows, see_that_it_can_be_written, write
    from skyless.studies.catalogue import STUDIES
    from skyless.studies.plan import plan_of

    asked = integrity_of(integrity_risk, alert_limit_m, None)
    if name != "integrity" and (integrity_risk is not None or alert_limit_m is not None):
        raise SkylessError("--integrity-risk and --alert-limit-m are for the study integrity")
    _see_that_it_applies(name, episodes, {"worlds": worlds, "seconds": seconds, "noise-ps": noise_ps, "qa": qa})
    if scheduler is not None and processes is not None:
        raise SkylessError("--processes are on this machine, --scheduler is for others; give either")
    see_that_it_can_be_written(plot, out)
    plan = plan_of(
        method or _USUAL_METHOD,
        seed,
        study=name,
        quick=quick,
        noise_ps=noise_ps or 100.0,
        qa=qa or 0.3,
        mesh=not without_mesh,
        worlds=worlds,
        seconds=seconds,
        episodes=episodes,
        integrity_risk=asked.risk,
        alert_limit_m=asked.alert_limit_m,
    )
    started_s = time.perf_counter()
    chosen = STUDIES[name]
    rows = _run(chosen, plan, scheduler, processes)
    write(chosen, rows, plot, out)
    print_rows(chosen, plan, rows, time.perf_counter() - started_s, json=json)


def _see_that_it_applies(name: str, episodes: int | None, others: dict[str, float | None]) -> None:
    if name not in _OF_EPISODES and episodes is not None:
        takes = f"{name} takes --worlds and --seconds"
        raise SkylessError(f"--episodes is for the studies efficiency and integrity; {takes}")
    given = [option for option, value in others.items() if value is not None]
    if name == "integrity":
        unfit = [option for option in given if option in {"worlds", "seconds"}]
        if unfit:
            raise SkylessError(f"--{unfit[0]} is not for the study integrity; give --episodes")
    if name == "efficiency" and given:
        raise SkylessError(f"--{given[0]} is not for the study efficiency, which has cases of its own; give --episodes")


def _run(chosen: "Study", plan: "Plan", scheduler: str | None, processes: int | None) -> "list[Row]":
    from skyless.evaluation.compile_ahead import compile_kernels
    from skyless.studies.runner import run_cells, run_cells_on_dask

    known_method(plan.method)
    cells = chosen.cells(plan)
    with status("loading the kernels; the first start compiles them, which takes some ten seconds"):
        compile_kernels(plan.method)
    try:
        with progress_bar(f"studying {chosen.title}", 1.0) as bar:
            if scheduler is None:
                results = run_cells(cells, bar.reach, processes)
            else:
                results = run_cells_on_dask(cells, bar.reach, scheduler)
    except KeyboardInterrupt:
        print("stopped; nothing was written", file=sys.stderr)
        raise
    return chosen.rows(plan, results)
