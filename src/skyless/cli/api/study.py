"""``skyless.study``: the errors of tags over many simulated worlds."""

import time
from collections.abc import Iterator
from operator import methodcaller
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import asdict

from skyless.arguments import check_choice, python_function
from skyless.cli.api.fixes import Result, data_frame, figures
from skyless.cli.api.options import StudyOptions
from skyless.cli.common import cm
from skyless.core.arrays import Vector
from skyless.research.studies.picture import draw
from skyless.research.studies.run import STUDIES, Parts
from skyless.research.studies.run import run_study as rows_of_study
from skyless.research.studies.runner import Plan, Row, plan_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


class StudyResult(Result, frozen=True, eq=False):
    """Simulated rows of a study, one per case."""

    name: str
    plan: Plan
    """Amount and conditions of the simulations."""
    rows: tuple[Row, ...]
    """n rows with all figures."""
    wall_s: float
    parts: Parts
    """Numbers of parts that were computed, and that came from the folder ``resume``."""

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of the n cases."""
        return tuple(row.case for row in self.rows)

    @property
    def rmse_m(self) -> Vector:
        """RMSE of each case, shape (n,); NaN if it has none."""
        return self.column("rmse_m")

    def column(self, name: str) -> Vector:
        """One field of all rows, shape (n,); NaN where it does not apply. Raises SkylessError."""
        check_choice("name", name, tuple(one for one in self._fields if self._is_number(one)))
        return figures(getattr(row, name) for row in self.rows)

    @property
    def _fields(self) -> tuple[str, ...]:
        return self.rows[0].__struct_fields__

    def _is_number(self, name: str) -> bool:
        return all(isinstance(getattr(row, name), int | float | None) for row in self.rows)

    @property
    def summary(self) -> dict[str, Any]:
        """The object that ``skyless study --json`` writes, in SI units, without the version."""
        rows = msgspec.to_builtins(self.rows, enc_hook=methodcaller("tolist"))
        return {
            "study": self.name, "simulated": True, **msgspec.to_builtins(self.plan), "wall_s": self.wall_s,
            "parts": msgspec.to_builtins(self.parts), "rows": rows,
        }  # fmt: skip

    def to_dataframe(self) -> "DataFrame":
        """One row per case, with all fields of the study's ``Row``; NaN where a number does not apply.

        Raises:
            SkylessError: pandas is not installed.
        """
        columns: dict[str, Any] = {}
        for name in self._fields:
            values = [getattr(row, name) for row in self.rows]
            has_gaps = None in values and self._is_number(name)
            columns[name] = figures(values) if has_gaps else values
        return data_frame(columns)

    def plot(self) -> "Figure":
        """Draw the picture that ``skyless study --plot`` writes."""
        return draw(STUDIES[self.name], self.rows)

    def title(self) -> str:
        """Title of the study."""
        return f"{STUDIES[self.name].title}: {self.plan.method}, seed {self.plan.seed}, simulated"

    def facts(self) -> Iterator[tuple[str, str]]:
        """The main figures: name, and value with its unit."""
        for row in self.rows:
            nees = "" if row.nees is None else f", NEES {row.nees:.2f}"
            limits = "" if row.passed is None else ", limits held" if row.passed else ", limits missed"
            yield row.case, f"RMSE {cm(row.rmse_m)}{nees}{limits}"


def run_study(asked: StudyOptions) -> StudyResult:
    """Measure errors over many simulated runs, as ``skyless study`` does.

    Several processes import the calling script, so call this below ``if __name__ == "__main__":``.
    """
    started_s = time.perf_counter()
    amounts = {name: value for name, value in asdict(asked).items() if name in Plan.__struct_fields__}
    plan = plan_of(study=asked.name, **amounts)
    chosen, resume = STUDIES[asked.name], asked.resume
    rows, parts = rows_of_study(chosen, plan, asked.progress, asked.processes, resume)
    asked.progress(1.0)
    return StudyResult(asked.name, plan, tuple(rows), time.perf_counter() - started_s, parts)


study = python_function(StudyOptions, run_study)
