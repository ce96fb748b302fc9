"""The study ``watch``: how reliably and how fast moved anchors are found, and how many findings are wrong.

Ranges are drawn: noise of the stamps, and drift of each pair (a Gauss–Markov process) as real rooms have it. Events
come one after another, each on another anchor or link, and end when they are found.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.research.studies.runner import Cell, Limit, Plan, Row, missed_limits, seed_of
from skyless.research.surveys.drawn_faults import (
    Event,
    WatchResult,
    WatchRun,
    run_watch,
    striking_windows,
)
from skyless.research.surveys.rooms import survey_layouts

_LAYOUTS: Final = ("lab", "room", "hall")
_EVENTS: Final = 50
"""Events in a world."""
_QUIET_WINDOWS: Final = 1080
"""Windows of 10 s without an event in a world: three hours."""
_QUIET_DRIFTS_S: Final = (10.0, 60.0, 600.0)
_REAL_DRIFT_M: Final = (0.008, 0.025)
_LIVELY_M: Final = 0.09
_NOISE_WINDOWS: Final = 1_000_000
_NOISE_WINDOW_S: Final = 0.1
_NOISE_ALARM: Final = 1e-7
_NOISE_CASE: Final = "lab, 10⁶ windows of noise"

_IN_TIME_S: Final = 30.0
_DAY_S: Final = 86_400.0
_EVENT_S: Final = 0.05
"""About what an event takes to compute, and a window without one."""
_WINDOW_S: Final = 1.5e-3


class _Case(Struct, frozen=True):
    name: str
    series: str
    layout: str
    event: Event
    size_m: float
    drift_m: tuple[float, float] = (0.02, 0.02)
    drift_s: float = 60.0
    lively_m: float = 0.0
    missing: float = 0.0
    limits: tuple[Limit, ...] = ()

    def run(self, events: int, seed: int) -> WatchRun:
        """Run some of its events, or windows without any."""
        drift = (self.drift_m, self.drift_s, self.lively_m)
        return WatchRun(survey_layouts()[self.layout], self.event, self.size_m, *drift, self.missing, events, seed)


class WatchRow(Row, frozen=True, kw_only=True):
    """Findings of the watch of the anchors in the events of a case."""

    found: float | None = None
    """Share of events that were found in time."""
    named: float | None = None
    """Share of those found whose anchors or links were named, and no others."""
    kind: float | None = None
    """Share of those found that also have the right kind of event."""
    wrong: float | None = None
    """Share of events with a false report that an anchor has moved or its delay has changed."""
    found_s: float | None = None
    """Time from the event to the finding, 99th percentile."""
    alarms_per_day: float | None = None
    """Findings while nothing happened."""
    alarms: int | None = None
    """Number of these findings, or of windows with an alarm."""


def _cases() -> list[_Case]:
    found = []
    for layout in _LAYOUTS:
        certain = (Limit("found", least=0.99),) if layout == "hall" else ()
        never = (Limit("wrong", most=0.005),)
        series = f"{layout}, drift 2 cm"
        found += [
            _Case(f"{layout}, moved 10 cm", series, layout, "moved", 0.1, limits=(*certain, *never)),
            _Case(f"{layout}, moved 20 cm", series, layout, "moved", 0.2, limits=never),
            _Case(f"{layout}, moved 2 m", series, layout, "moved", 2.0, limits=never),
            _Case(f"{layout}, moved 30 cm, 30 % of pairs missing", series, layout, "moved", 0.3, missing=0.3),
            _Case(f"{layout}, two moved 30 cm", series, layout, "two moved", 0.3),
            _Case(f"{layout}, moved 30 cm at 1 mm/s", series, layout, "slow", 0.3),
            _Case(f"{layout}, delay 10 cm", series, layout, "delay", 0.1),
            _Case(f"{layout}, one link 35 cm late", series, layout, "link", 0.35, limits=never),
            _Case(f"{layout}, a person on some links", series, layout, "door", 0.0),
        ]
    for layout in _LAYOUTS:
        for drift_s in _QUIET_DRIFTS_S:
            name = f"{layout}, nothing, drift of {drift_s:g} s"
            series = "nothing happens, drift 0.8 to 2.5 cm, one pair 9 cm"
            found.append(_Case(name, series, layout, "none", 0.0, _REAL_DRIFT_M, drift_s, _LIVELY_M))
    return found


def cells(plan: Plan) -> list[Cell]:
    """One for each case and world."""
    worlds = []
    for number, case in enumerate(_cases()):
        events = _QUIET_WINDOWS if case.event == "none" else _EVENTS
        for world in range(plan.worlds):
            run = case.run(events, seed_of(plan.seed, number, world))
            weight_s = events * (_WINDOW_S if case.event == "none" else _EVENT_S)
            worlds.append(Cell(case.name, partial(run_watch, run), weight_s))
    windows = _NOISE_WINDOWS // plan.worlds
    for world in range(plan.worlds):
        seed = seed_of(plan.seed, len(_cases()), world)
        noise = partial(striking_windows, survey_layouts()["lab"], _NOISE_WINDOW_S, _NOISE_ALARM, windows, seed)
        worlds.append(Cell(_NOISE_CASE, noise, 4e-6 * windows))
    return worlds


def rows(plan: Plan, results: Sequence[Any]) -> Sequence[Row]:
    """One for each case."""
    of_case = [results[start : start + plan.worlds] for start in range(0, len(results), plan.worlds)]
    *of_drawn, of_noise = of_case
    found = [_row(plan, case, one) for case, one in zip(_cases(), of_drawn, strict=True)]
    windows, limits = plan.worlds * (_NOISE_WINDOWS // plan.worlds), (Limit("alarms", most=1),)
    noise = _judged(plan, _NOISE_CASE, "windows of 0.1 s, no drift", windows, limits, alarms=sum(of_noise))
    return [noise, *found]


def _row(plan: Plan, case: _Case, results: Sequence[WatchResult]) -> WatchRow:
    tries = sum(one.tries for one in results)
    alarms = sum(one.alarms for one in results)
    windows = sum(one.windows for one in results)
    if case.event == "none":
        per_day = alarms / (windows * 10.0 / _DAY_S)
        return _judged(plan, case.name, case.series, windows, (), alarms=alarms, alarms_per_day=per_day)
    times_s = np.array([time_s for one in results for time_s in one.found_s])
    in_time_s = np.inf if case.event == "slow" else _IN_TIME_S
    found = max(sum(one.found for one in results), 1)
    figures = {
        "found": float((times_s <= in_time_s).sum() / tries),
        "named": sum(one.named for one in results) / found,
        "kind": sum(one.kind for one in results) / found,
        "wrong": sum(one.wrong for one in results) / tries,
        "found_s": float(np.quantile(times_s, 0.99)) if len(times_s) else None,
    }
    return _judged(plan, case.name, case.series, tries, case.limits, **figures)


def _judged(plan: Plan, case: str, series: str, runs: int, limits: tuple[Limit, ...], **figures: Any) -> WatchRow:  # noqa: ANN401 - of the row
    row = WatchRow(
        study="watch", method=plan.method, case=case, series=series, noise_ps=plan.noise_ps, runs=runs, **figures
    )
    missed = missed_limits(row, limits)
    return replace(row, limits=limits, missed=missed, passed=not missed if limits else None)
