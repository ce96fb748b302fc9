"""A benchmark as a page, a table and JSON."""

import csv
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from io import StringIO
from pathlib import Path
from typing import Final

import msgspec
import numpy as np
from matplotlib.figure import Figure
from msgspec import structs

from skyless.core.arrays import Matrix
from skyless.core.whole_files import replace_files
from skyless.research.benchmark.run import BEST, JOINT, PLAIN, Result
from skyless.sim.evaluation.figures import Figures
from skyless.site.report import bullets, page, panel, picture, report_style, svg_figure, table

_HEADS: Final = (
    *("recording", "method", "judged", "RMSE 2-D", "3-D", "50 %", "95 %", "largest", "bias x, y, z", "σ", "NEES"),
    *("beyond 95 %", "levels", "exceeded h, v", "median level", "available", "first fix", "ATE", "RPE"),
)
_NUMBERS: Final = tuple(
    name
    for name in Figures.__struct_fields__
    if name not in {"left_out", "alerts", "median_m", "std_m", "rmse_axes_m", "bias_m"}
)
_TRIPLES: Final = ("median_m", "std_m", "rmse_axes_m", "bias_m")
_DIVERGED_M: Final = 1.0
"""What has a larger error has lost the tag: no ratio to it is made."""


def write(folder: Path, results: Sequence[Result], title: str, command: str) -> None:
    """Write ``index.html``, ``results.csv`` and ``results.json`` into the folder. Raises OSError."""
    without_drawn = [structs.replace(one, drawn=()) for one in results]
    table_of_all = StringIO()
    rows = csv.writer(table_of_all)
    axes = (f"{name[:-1]}{axis}_m" for name in _TRIPLES for axis in "xyz")
    rows.writerow(["recording", "method", "reason", *_NUMBERS, *axes])
    rows.writerows(_csv_row(one) for one in results)
    files = {
        "results.json": msgspec.json.format(msgspec.json.encode(without_drawn), indent=1),
        "results.csv": table_of_all.getvalue().encode(),
        "index.html": _page(results, title, command).encode(),
    }
    replace_files({folder / name: data for name, data in files.items()})


def _csv_row(result: Result) -> list[object]:
    found = result.figures or Figures()
    triples = (value for name in _TRIPLES for value in getattr(found, name) or (None, None, None))
    return [result.recording, result.method, result.reason, *(getattr(found, name) for name in _NUMBERS), *triples]


def ratios(results: Sequence[Result], method: str, other_method: str = PLAIN) -> dict[str, float | int]:
    """Geometric means of a method's errors over another's, of recordings that both were judged on."""
    others = {one.recording: one.figures for one in results if one.method == other_method and one.figures is not None}
    found: dict[str, list[float]] = defaultdict(list)
    for one in results:
        other = others.get(one.recording)
        if one.method == method and one.figures is not None and other is not None:
            for name in ("rmse_2d_m", "rmse_3d_m"):
                mine_m, its_m = getattr(one.figures, name), getattr(other, name)
                if mine_m is not None and its_m is not None and its_m < _DIVERGED_M:
                    found[name].append(float(np.log(mine_m / its_m)))
    means: dict[str, float | int] = {name: float(np.exp(np.mean(logs))) for name, logs in found.items()}
    return {**means, "recordings": len(found["rmse_2d_m"])}


def summary_rows(results: Sequence[Result]) -> Iterator[tuple[str, ...]]:
    """One line for each method: ratios to the plain filter and to the best simple one, NEES, and levels exceeded."""
    for method in dict.fromkeys(one.method for one in results):
        found = [ratios(results, method, other) for other in (PLAIN, BEST)]
        judged = [one.figures for one in results if one.method == method and one.figures and one.figures.judged]
        nees = [one.nees for one in judged if one.nees is not None]
        exceeded = (sum(getattr(one, f"exceeded_{way}") for one in judged) for way in ("horizontal", "vertical"))
        yield (
            method,
            f"{len(judged)}",
            *(_number(ratio.get(name), ".3f") for ratio in found for name in ("rmse_2d_m", "rmse_3d_m")),
            f"{np.median(nees):.2f} ({min(nees):.2f} to {max(nees):.2f})" if nees else "–",
            f"{sum(one.levels for one in judged)}",
            ", ".join(map(str, exceeded)),
        )


SUMMARY_HEADS: Final = (
    *("method", "recordings", "2-D / gate", "3-D / gate", "2-D / best simple", "3-D / best simple"),
    *("NEES", "levels", "exceeded h, v"),
)


def _page(results: Sequence[Result], title: str, command: str) -> str:
    by_recording: Mapping[str, list[Result]] = defaultdict(list)
    for one in results:
        by_recording[one.recording].append(one)
    failed = [f"{one.recording}, {one.method}: {one.reason}" for one in results if one.figures is None]
    rows = [_row(one) for one in results if one.figures is not None]
    parts = [
        f"<header><h1>{escape(title)}</h1>\n<p>Fixes are of methods as they stand. "
        "Figures are defined in <code>docs/recordings.md</code>; lengths in metres. Made by "
        f"<code>{escape(command)}</code>; the same figures are in <code>results.csv</code> and "
        "<code>results.json</code>.</p></header>",
        "<section><h2>Methods</h2>",
        table(SUMMARY_HEADS, summary_rows(results)),
        "<p class='note'>Ratios are geometric means of RMSE over that of the plain filter with a gate (gate), "
        "and over that of the best of it, gradient and least squares on each recording (best simple), of recordings "
        "where that is below 1 m.</p>"
        "</section><section><h2>Recordings</h2>",
        table(_HEADS, rows),
        "</section>",
    ]
    if failed:
        parts.append("<section><h2>Left out</h2>" + bullets(failed, "warning") + "</section>")
    parts += [_section(number, name, ones) for number, (name, ones) in enumerate(by_recording.items())]
    return page(title, parts)


def _row(result: Result) -> tuple[str, ...]:
    found = result.figures
    assert found is not None
    over = "3d" if found.rmse_3d_m is not None else "2d"
    of_all = (getattr(found, f"{name}_{over}_m") for name in ("p50", "p95", "max"))
    return (
        *(result.recording, result.method, f"{found.judged}, {found.judged_s:.0f} s"),
        *(_number(value, ".3f") for value in (found.rmse_2d_m, found.rmse_3d_m, *of_all)),
        "–" if found.bias_m is None else ", ".join(f"{value:.3f}" for value in found.bias_m),
        _number(getattr(found, f"sigma_{over}_m"), ".3f"),
        _number(found.nees, ".2f"),
        _number(found.beyond_95, ".1%"),
        f"{found.levels}",
        f"{found.exceeded_horizontal}, {found.exceeded_vertical}",
        _number(found.hpl_m, ".2f"),
        _number(found.availability, ".1%"),
        _number(found.first_fix_s, ".2f"),
        *(_number(value, ".3f") for value in (found.ate_m, found.rpe_m)),
    )


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _section(number: int, name: str, results: Sequence[Result]) -> str:
    drawn = {one.method: np.array(one.drawn, dtype=np.float64) for one in results if one.drawn}
    if not drawn:
        return ""
    with report_style():
        panels = {
            "Map; the line is the truth": _map(drawn),
            "Error over time": _over_time(drawn),
            f"Horizontal errors of {JOINT} and its protection levels (Stanford diagram)": _levels(drawn),
        }
        figures = "\n".join(
            svg_figure(picture(figure, "svg", 60.0), f"recording{number}_{place}", caption)
            for place, (caption, figure) in enumerate(panels.items())
        )
    return f"<section><h2>{escape(name)}</h2><div class='panels'>{figures}</div></section>"


def _map(drawn: Mapping[str, Matrix]) -> Figure:
    """Of rows of time, position, truth and levels by method."""
    figure, axes = panel("")
    truth_m = next(iter(drawn.values()))[:, 4:6]
    for method, rows in drawn.items():
        axes.plot(rows[:, 1], rows[:, 2], ".", markersize=2, rasterized=True, label=method)
    axes.plot(*truth_m.T, color="black", linewidth=0.7)
    if np.isfinite(truth_m).any():  # a filter that has lost its tag shall not fill the map
        low_m, high_m = np.nanmin(truth_m, axis=0) - 1.0, np.nanmax(truth_m, axis=0) + 1.0
        axes.set(xlim=(low_m[0], high_m[0]), ylim=(low_m[1], high_m[1]))
    axes.set(xlabel="x in m", ylabel="y in m", aspect="equal")
    return figure


def _over_time(drawn: Mapping[str, Matrix]) -> Figure:
    figure, axes = panel("")
    begin_s = min(rows[0, 0] for rows in drawn.values())
    for method, rows in drawn.items():
        error_m = np.linalg.norm(rows[:, 1:4] - rows[:, 4:7], axis=1)
        axes.plot(rows[:, 0] - begin_s, error_m, linewidth=0.7, label=method)
    axes.set(xlabel="time in s", ylabel="error in m", yscale="log")
    axes.legend(fontsize="x-small")
    return figure


def _levels(drawn: Mapping[str, Matrix]) -> Figure:
    figure, axes = panel("")
    rows = drawn.get(JOINT, np.empty((0, 9)))
    error_m = np.linalg.norm(rows[:, 1:3] - rows[:, 4:6], axis=1)
    most_m = 1.05 * float(np.nanmax([*error_m, *rows[:, 7], 0.1]))
    axes.plot(error_m, rows[:, 7], ".", markersize=2, rasterized=True)
    axes.plot([0.0, most_m], [0.0, most_m], color="black", linewidth=0.7)
    axes.set(xlabel="error in m", ylabel="level in m", xlim=(0.0, most_m), ylim=(0.0, most_m))
    return figure
