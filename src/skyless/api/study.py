"""``skyless.study``: how accurate the receiver is under which conditions, over many runs in the simulated world."""

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from skyless.api.inputs import Progress, silent
from skyless.api.result import Result, cm, data_frame, figures
from skyless.arguments import (
    check_choice,
    check_number,
    check_whole,
    named_as_arguments,
    process_noise,
)
from skyless.errors import SkylessError
from skyless.evaluation.scenarios import NOISIEST_PS
from skyless.kernels.arrays import Vector
from skyless.method_names import DEFAULT_METHOD, METHODS
from skyless.positioning.integrity import RISK
from skyless.studies.catalogue import STUDIES
from skyless.studies.common.plan import Plan, Row, plan_of
from skyless.studies.run import check_amounts, run_study

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


class StudyResult(Result, frozen=True, eq=False):
    """Rows of a study, one a case; all is simulated."""

    name: str
    plan: Plan
    """How much was simulated, and with what."""
    rows: tuple[Row, ...]
    """n rows with all figures."""
    wall_s: float

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of the n cases."""
        return tuple(row.case for row in self.rows)

    @property
    def rmse_m(self) -> Vector:
        """Shape (n,); NaN where a case has none."""
        return self.column("rmse_m")

    def column(self, name: str) -> Vector:
        """A figure of all rows by its name in ``Row``, shape (n,); NaN where it does not apply. Raises SkylessError."""
        numbers = tuple(one for one in Row.__struct_fields__ if self._is_number(one))
        check_choice("name", name, numbers)
        return figures(getattr(row, name) for row in self.rows)

    def _is_number(self, name: str) -> bool:
        return all(isinstance(getattr(row, name), int | float | None) for row in self.rows)

    @property
    def summary(self) -> dict[str, Any]:
        """The object that ``skyless study --json`` writes, in SI units, but for the version."""
        rows = msgspec.to_builtins(self.rows, enc_hook=np.ndarray.tolist)
        return {
            "study": self.name, "simulated": True, **msgspec.to_builtins(self.plan), "wall_s": self.wall_s,
            "rows": rows,
        }  # fmt: skip

    def to_dataframe(self) -> "DataFrame":
        """One row a case, with all fields of ``skyless.studies.common.plan.Row``; NaN where a number does not apply.

        Raises:
            SkylessError: pandas is not installed.
        """
        columns: dict[str, Any] = {}
        for name in Row.__struct_fields__:
            values = [getattr(row, name) for row in self.rows]
            has_gaps = None in values and self._is_number(name)
            columns[name] = figures(values) if has_gaps else values
        return data_frame(columns)

    def plot(self) -> "Figure":
        """The picture that ``skyless study --plot`` writes."""
        return STUDIES[self.name].draw(self.rows)

    def _title(self) -> str:
        return f"{STUDIES[self.name].title}: {self.plan.method}, seed {self.plan.seed}, simulated"

    def _facts(self) -> Iterator[tuple[str, str]]:
        for row in self.rows:
            nees = "" if row.nees is None else f", NEES {row.nees:.2f}"
            limits = "" if row.passed is None else ", limits held" if row.passed else ", limits missed"
            yield row.case, f"RMSE {cm(row.rmse_m)}{nees}{limits}"


def study(
    name: str,
    *,
    method: str = DEFAULT_METHOD,
    seed: int = 1,
    episodes: int | None = None,
    worlds: int | None = None,
    seconds: float | None = None,
    noise_ps: float | None = None,
    qa: float | None = None,
    dynamics: str | None = None,
    integrity_risk: float | None = None,
    alert_limit_m: float | None = None,
    mesh: bool = True,
    quick: bool = False,
    processes: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> StudyResult:
    """Measure errors over many simulated runs, as ``skyless study`` does.

    Several processes import the script that calls this: there it stands below ``if __name__ == "__main__":``.

    Args:
        name: ``efficiency``, ``loss``, ``nlos``, ``motion``, ``sync``, ``integrity``, ``room``, ``large``, ``claims``,
            ``survey``, ``survey-room``, ``watch``, ``sitetime`` or ``scale``.
        method: One of ``skyless.METHODS``.
        seed: Same seed, same rows; CPU times apart.
        episodes: Episodes of two seconds for each case (efficiency, integrity).
        worlds: Independent worlds for each case (all others).
        seconds: Simulated seconds for which each world is judged.
        noise_ps: Noise of every TX and RX stamp, known to the filters; 100 by default.
        qa: Process noise that filters assume at rest, spectral density of the acceleration in m²/s³; 0.3 by default.
        dynamics: How tags move: ``walk`` (as people), ``robot`` or ``drone``, which sets the process noise instead.
        integrity_risk: Probability, for each fix, that the error exceeds its protection level (integrity).
        alert_limit_m: Fixes whose level exceeds this count as not available (integrity).
        mesh: Whether anchors also relay when they heard anchors that are not the master.
        quick: Simulate a fraction, with more scatter.
        processes: Processes on this machine, by default one for each core; 1 is the present one.
        scheduler: Address of a Dask scheduler whose workers do the work instead.
        progress: Called now and then with the share done.

    Raises:
        SkylessError: one line that names the argument, its value and what it should be.
    """
    check_choice("name", name, tuple(STUDIES))
    check_choice("method", method, METHODS)
    check_whole("seed", seed, least=0)
    check_whole("episodes", episodes, least=1, most=10**6)
    check_whole("worlds", worlds, least=2, most=10**5)
    check_number("seconds", seconds, least=1.0, most=1e6)
    check_number("noise_ps", noise_ps, above=0.0, most=NOISIEST_PS)
    check_number("qa", qa, above=0.0)
    check_number("integrity_risk", integrity_risk, above=0.0, most=0.1)
    check_number("alert_limit_m", alert_limit_m, above=0.0)
    check_whole("processes", processes, least=1, most=1024)
    if scheduler is not None and processes is not None:
        raise SkylessError("processes are on this machine, scheduler is for others; give either")
    with named_as_arguments({}):
        noise = process_noise(qa, dynamics)
    started_s, chosen = time.perf_counter(), STUDIES[name]
    plan = plan_of(
        method,
        seed,
        study=name,
        quick=quick,
        noise_ps=noise_ps or 100.0,
        qa=noise or 0.3,
        mesh=mesh,
        worlds=worlds,
        seconds=seconds,
        episodes=episodes,
        integrity_risk=integrity_risk or RISK,
        alert_limit_m=alert_limit_m,
    )
    with named_as_arguments({}):
        check_amounts(
            name,
            episodes=episodes,
            worlds=worlds,
            seconds=seconds,
            noise_ps=noise_ps,
            qa=qa,
            dynamics=dynamics,
            integrity_risk=integrity_risk,
            alert_limit_m=alert_limit_m,
        )
        report_progress = progress or silent
        rows = run_study(chosen, plan, report_progress, processes, scheduler)
        report_progress(1.0)
    return StudyResult(name, plan, tuple(rows), time.perf_counter() - started_s)
