"""A survey's report: first warnings about what is uncertain, then tables; or one JSON object."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

from skyless.cli.common.output import cm, console, number, print_json, print_warnings

if TYPE_CHECKING:
    from rich.table import Table

    from skyless.survey.count import Count
    from skyless.survey.result import Survey, SurveyedPair, TapeAdvice

_WORST: Final = 8
"""Pairs that are shown, those with the largest residuals."""


class SurveyReport(Struct, frozen=True):
    """A survey and what belongs to its report."""

    survey: "Survey"
    count: "Count"
    warnings: tuple[str, ...]
    """About the inputs and the facts that were stated."""
    drops: tuple[str, ...] = ()
    """What could not be used of the recording, by reason."""
    unchanged: tuple[int, ...] = ()
    """Anchors of the site file that stay as they are."""
    written: tuple[str, ...] = ()
    """Files that were written."""

    @property
    def usable(self) -> bool:
        """Whether any anchor is determined, and by a range."""
        found = any(anchor.determined for anchor in self.survey.anchors)
        return found and any(pair.residual_m is not None for pair in self.survey.pairs)


def print_report(report: SurveyReport) -> None:
    """Write the report as one line of JSON."""
    print_json(report_object(report))


def report_object(report: SurveyReport) -> dict[str, Any]:
    """All of the survey, under the names of its fields, but for a shorter ``ambiguous`` and ``excluded_pairs``."""
    import msgspec

    survey: dict[str, Any] = msgspec.to_builtins(report.survey)
    survey["ambiguous"] = survey.pop("ambiguities")
    survey["excluded_pairs"] = [[pair.a, pair.b] for pair in report.survey.pairs if pair.excluded]
    return survey | {
        "usable": report.usable,
        "count": msgspec.to_builtins(report.count),
        "warnings": list(report.warnings),
        "drops": list(report.drops),
        "unchanged": list(report.unchanged),
        "written": list(report.written),
    }


def show_report(report: SurveyReport) -> None:
    """Show the report as warnings, tables and lines of text."""
    survey, screen = report.survey, console()
    print_warnings(
        [
            *report.warnings,
            *(f"ambiguous: {one.sentence}" for one in survey.ambiguities),
            *([] if survey.unchecked is None else [survey.unchecked]),
            *([] if survey.assumed_heights is None else [f"{survey.assumed_heights} (--anchor-height)"]),
            *survey.not_determined,
        ]
    )
    for note in survey.notes:
        screen.print(f"note: {note}", markup=False)
    screen.print(_anchors(survey))
    checked = [pair for pair in survey.pairs if pair.residual_m is not None]
    if checked:
        screen.print(_pairs(checked))
    excluded = ", ".join(f"{pair.a}–{pair.b}{_late(pair)}" for pair in survey.pairs if pair.excluded)
    lines = [
        f"left out as late: {excluded or 'no pair'}",
        f"constant error of a pair: {cm(survey.range_std_m)}; {_checks(survey.redundancy)}",
        *_tapes(survey.tapes),
        survey.frame,
        *report.drops,
    ]
    if report.unchanged and report.written:
        lines.append(f"unchanged in the file: anchor {', '.join(map(str, report.unchanged))}")
    lines += [f"wrote {file}" for file in report.written]
    lines += [f"next: start the anchors with {file}" for file in report.written[-2:-1] if file.endswith(".toml")]
    for line in lines:
        screen.print(line, markup=False)


def _anchors(survey: "Survey") -> "Table":
    from rich.table import Table

    table = Table(title="anchors")
    for name in ("anchor", "x / m", "y / m", "z / m", "± / cm", "delay / cm", "± / cm"):
        table.add_column(name, justify="right")
    table.add_column("")
    for one in survey.anchors:
        position = [number(value) for value in (one.x_m, one.y_m, one.z_m)]
        others = [number(value, "{:.2f}", 100.0) for value in (one.std_m, one.delay_m, one.delay_std_m)]
        table.add_row(str(one.id), *position, *others, "" if one.determined else "not determined")
    return table


def _pairs(checked: Sequence["SurveyedPair"]) -> "Table":
    """Those whose ranges differ most from the result."""
    from rich.table import Table

    worst = sorted(checked, key=lambda pair: -abs(pair.residual_m or 0.0))[:_WORST]
    shown = "all pairs" if len(worst) == len(checked) else f"the {len(worst)} of {len(checked)} pairs that fit worst"
    table = Table(title=shown)
    for name in ("pair", "range / m", "range − result / cm", "± / cm"):
        table.add_column(name, justify="right")
    table.add_column("")
    for pair in worst:
        figures = [number(pair.residual_m, "{:+.2f}", 100.0), number(pair.std_m, "{:.2f}", 100.0)]
        table.add_row(f"{pair.a}–{pair.b}", number(pair.range_m), *figures, "left out" if pair.excluded else "")
    return table


def _late(pair: "SurveyedPair") -> str:
    return "" if pair.residual_m is None else f" ({pair.residual_m:+.2f} m)"


def _checks(redundancy: int) -> str:
    if redundancy <= 0:
        return "no range checks the result"
    return "1 range checks the result" if redundancy == 1 else f"{redundancy} ranges check the result"


def _tapes(tapes: Sequence["TapeAdvice"]) -> list[str]:
    """Which distances to measure next, and how accurate the positions would be then."""
    lines = []
    for rank, tape in enumerate(tapes):
        ask = "the tape that helps most" if rank == 0 else "then"
        gain = f"{cm(tape.std_before_m)} → {cm(tape.std_after_m)}"
        lines.append(f"{ask}: between {tape.a} and {tape.b}, {gain} (--distance {tape.a}-{tape.b}=METRES)")
    return lines
