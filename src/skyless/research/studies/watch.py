"""The study ``watch``: how reliably and how fast moved anchors are found, and how many findings are wrong.

Ranges are drawn: noise of the stamps, and drift of each pair (a Gauss–Markov process) as real rooms have it. Events
come one after another, each on another anchor or link, and end when they are found.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, Final, Literal

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array, Integers, Mask
from skyless.core.ticks import SPEED_OF_LIGHT_MPS
from skyless.research.studies.runner import Cell, Limit, Plan, Row, of_cases, seed_of, with_limits
from skyless.research.studies.surveyed_rooms import SLOT_S, SurveyLayout, survey_layouts
from skyless.site.survey.explain import Finding, Kind, is_significant, pairs_of
from skyless.site.survey.facts import PairBlock
from skyless.site.survey.watch import GRACE_S, AnchorWatch

Event = Literal["none", "moved", "delay", "link", "door", "two moved", "slow"]

_WINDOW_S: Final = 10.0
_STAMP_S: Final = 100e-12
"""Noise of every TX and RX stamp."""

LEARNING_WINDOWS: Final = 60
_LASTS_WINDOWS: Final = 4
"""Longest duration of an event, which ends when it is found."""
_SLOW_MPS: Final = 1e-3
_RETURN_WINDOWS: Final = 6
"""Windows between two events, within which findings should end."""

_DOOR_REACH_M: Final = 0.3
_DOOR_LATE_M: Final = (0.1, 0.5)

_CHUNK: Final = 20_000

_Truth = set[tuple[Kind, tuple[int, ...]]]
"""Kinds and anchors of true findings."""


class WatchCase(Struct, frozen=True):
    """A kind of event at a watched site."""

    name: str
    series: str
    layout: str
    event: Event
    size_m: float
    """Size of displacements, delays and lateness. Directions and anchors are drawn."""
    drift_m: tuple[float, float] = (0.02, 0.02)
    """Standard deviations of the pairs' drift are drawn between these; 0 for none."""
    drift_s: float = 60.0
    """Correlation time of the drift, a Gauss–Markov process."""
    lively_m: float = 0.0
    """Larger drift of a single pair; 0 for none."""
    missing: float = 0.0
    """Share of pairs without ranges."""
    limits: tuple[Limit, ...] = ()


class WatchResult(Struct, frozen=True):
    """Numbers of events in a run with certain findings, and of false alarms."""

    tries: int
    found: int
    """Events with any finding."""
    named: int
    """Events with only the right anchors or links named, as any kind."""
    kind: int
    """Events with also the right kind."""
    wrong: int
    """Events with an anchor wrongly said to have moved, or its delay to have changed."""
    found_s: tuple[float, ...]
    """Times from an event to its finding."""
    alarms: int
    """Findings while nothing happened."""
    alarms_moved: int
    """Alarms that an anchor has moved or its delay has changed."""
    windows: int


_LAYOUTS: Final = ("lab", "room", "hall")
_EVENTS: Final = 50
"""Events in a world."""
_QUIET_WINDOWS: Final = 1080
"""Windows of 10 s without an event in a world: three hours."""
_REAL_DRIFT_M: Final = (0.008, 0.025)
_LIVELY_M: Final = 0.09
_NOISE_WINDOWS: Final = 1_000_000
_NOISE_WINDOW_S: Final = 0.1
_NOISE_ALARM: Final = 1e-7
_NOISE_CASE: Final = "lab, 10⁶ windows of noise"

_IN_TIME_S: Final = 30.0
_DAY_S: Final = 86_400.0
_EVENT_COST_S: Final = 0.05
"""About what an event takes to compute, and a window without one."""
_QUIET_COST_S: Final = 1.5e-3


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


def _cases() -> list[WatchCase]:
    found = []
    for layout in _LAYOUTS:
        certain = (Limit("found", least=0.99),) if layout == "hall" else ()
        never = (Limit("wrong", most=0.005),)
        series = f"{layout}, drift 2 cm"
        found += [
            WatchCase(f"{layout}, moved 10 cm", series, layout, "moved", 0.1, limits=(*certain, *never)),
            WatchCase(f"{layout}, moved 20 cm", series, layout, "moved", 0.2, limits=never),
            WatchCase(f"{layout}, moved 2 m", series, layout, "moved", 2.0, limits=never),
            WatchCase(f"{layout}, moved 30 cm, 30 % of pairs missing", series, layout, "moved", 0.3, missing=0.3),
            WatchCase(f"{layout}, two moved 30 cm", series, layout, "two moved", 0.3),
            WatchCase(f"{layout}, moved 30 cm at 1 mm/s", series, layout, "slow", 0.3),
            WatchCase(f"{layout}, delay 10 cm", series, layout, "delay", 0.1),
            WatchCase(f"{layout}, one link 35 cm late", series, layout, "link", 0.35, limits=never),
            WatchCase(f"{layout}, a person on some links", series, layout, "door", 0.0),
        ]
    for layout in _LAYOUTS:
        for drift_s in (10.0, 60.0, 600.0):
            name = f"{layout}, nothing, drift of {drift_s:g} s"
            series = "nothing happens, drift 0.8 to 2.5 cm, one pair 9 cm"
            found.append(WatchCase(name, series, layout, "none", 0.0, _REAL_DRIFT_M, drift_s, _LIVELY_M))
    return found


def cells(plan: Plan) -> list[Cell]:
    """One for each case and world."""
    worlds = []
    for number, case in enumerate(_cases()):
        events = _QUIET_WINDOWS if case.event == "none" else _EVENTS
        for world in range(plan.worlds):
            run = partial(run_watch, case, events, seed_of(plan.seed, number, world))
            worlds.append(Cell(case.name, run, events * (_QUIET_COST_S if case.event == "none" else _EVENT_COST_S)))
    windows = _NOISE_WINDOWS // plan.worlds
    for world in range(plan.worlds):
        seed = seed_of(plan.seed, len(_cases()), world)
        noise = partial(striking_windows, survey_layouts()["lab"], _NOISE_WINDOW_S, _NOISE_ALARM, windows, seed)
        worlds.append(Cell(_NOISE_CASE, noise, 4e-6 * windows))
    return worlds


def rows(plan: Plan, results: Sequence[Any]) -> Sequence[Row]:
    """One for each case."""
    found = [_row(plan, case, own) for case, own in of_cases(_cases(), results[: -plan.worlds])]
    windows, limits = plan.worlds * (_NOISE_WINDOWS // plan.worlds), (Limit("alarms", most=1),)
    alarms = sum(results[-plan.worlds :])
    return [_judged(plan, _NOISE_CASE, "windows of 0.1 s, no drift", windows, limits, alarms=alarms), *found]


def _row(plan: Plan, case: WatchCase, results: Sequence[WatchResult]) -> WatchRow:
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
    return with_limits(row, limits)


# A site whose ranges are drawn, and events that change them


class _Site:
    """A simulated site with its current ranges, and its watch."""

    def __init__(self, case: WatchCase, draw: np.random.Generator) -> None:
        self.layout = survey_layouts()[case.layout]
        self.position_m = self.layout.position_m.copy()
        self.draw = draw
        n = len(self.position_m)
        self.first, self.second = np.triu_indices(n, 1)
        m = len(self.first)
        self.late_m = np.zeros(m)
        self.is_missing: Mask = np.zeros(m, np.bool_)
        self.is_missing[draw.choice(m, round(case.missing * m), replace=False)] = True
        self._drift_std_m = draw.uniform(*case.drift_m, m)
        if case.lively_m > 0.0:
            self._drift_std_m[draw.integers(m)] = case.lively_m
        self._drift_m = self._drift_std_m * draw.standard_normal(m)
        self._kept = math.exp(-_WINDOW_S / case.drift_s)
        self._superframe_s = n * SLOT_S
        self._stamp_m = _STAMP_S * SPEED_OF_LIGHT_MPS
        self.step = 0
        at_m = {
            anchor: (x, y, z) for anchor, (x, y, z) in zip(self.layout.anchors, self.position_m.tolist(), strict=True)
        }
        self.watch = AnchorWatch(at_m, self.layout.dimensions)

    def true_m(self) -> Array:
        """Ranges without drift and noise, shape (m,)."""
        apart = self.position_m[self.first] - self.position_m[self.second]
        return np.asarray(np.linalg.norm(apart, axis=1) + self.late_m)

    def run_step(self) -> None:
        """Simulate a window, and pass its blocks to the watch."""
        draw, m = self.draw, len(self.first)
        self._drift_m = self._kept * self._drift_m
        self._drift_m += math.sqrt(1.0 - self._kept**2) * self._drift_std_m * draw.standard_normal(m)
        start_s, end_s = self.step * _WINDOW_S, (self.step + 1) * _WINDOW_S
        frames = max(int(end_s / self._superframe_s + 1e-9) - int(start_s / self._superframe_s + 1e-9), 1)
        of_tx, of_rx = draw.standard_normal(len(self.position_m)), draw.standard_normal(m)
        noise_m = of_rx * math.sqrt(0.5) + 0.5 * (of_tx[self.first] + of_tx[self.second])
        range_m = self.true_m() + self._drift_m + noise_m * self._stamp_m / math.sqrt(frames)
        for pair in np.flatnonzero(~self.is_missing).tolist():
            a, b = int(self.first[pair]) + 1, int(self.second[pair]) + 1
            std_m = self._stamp_m / math.sqrt(frames)
            self.watch.add(PairBlock(a, b, 0.5 * (start_s + end_s), float(range_m[pair]), std_m, frames))
        self.step += 1
        self.watch.advance(self.step * _WINDOW_S + GRACE_S)


def run_watch(case: WatchCase, events: int, seed: int) -> WatchResult:
    """Run the events one after another, and count the watch's findings; ``events``: windows where nothing happens."""
    draw = np.random.default_rng(seed)
    site = _Site(case, draw)
    for _ in range(LEARNING_WINDOWS):
        site.run_step()
    if case.event == "none":
        return _undisturbed(site, events)
    found_s: list[float] = []
    counts = dict.fromkeys(("found", "named", "kind", "wrong"), 0)
    alarms = alarms_moved = windows = 0
    for _ in range(events):
        standing = site.watch.findings
        alarms += len(standing)
        alarms_moved += sum(one.kind in {"moved", "delay"} for one in standing)
        if standing:  # so that earlier findings do not count for the next event
            site.watch.accept()
        truth, findings, passed_s, took = _happen(site, case, draw)
        windows += took
        if findings:
            found_s.append(passed_s)
        counts["found"] += bool(findings)
        named = [one for one in findings if one.kind != "check"]
        anchors = {one for _, one in truth}
        counts["named"] += bool(findings) and all(one.anchors in anchors for one in findings)
        counts["kind"] += bool(named) and all((one.kind, one.anchors) in truth for one in findings)
        moved = {of for kind, of in truth if kind in {"moved", "delay"}}
        counts["wrong"] += any(one.kind in {"moved", "delay"} and one.anchors not in moved for one in named)
        for _ in range(_RETURN_WINDOWS):
            site.run_step()
            windows += 1
    return WatchResult(
        tries=events, found_s=tuple(found_s), alarms=alarms, alarms_moved=alarms_moved, windows=windows, **counts
    )


def _undisturbed(site: _Site, windows: int) -> WatchResult:
    """Count findings while nothing happens, each once when it appears."""
    known: _Truth = set()
    alarms = alarms_moved = 0
    for _ in range(windows):
        site.run_step()
        now = {(one.kind, one.anchors) for one in site.watch.findings}
        alarms += len(now - known)
        alarms_moved += sum(kind in {"moved", "delay"} for kind, _ in now - known)
        known = now
    return WatchResult(0, 0, 0, 0, 0, (), alarms, alarms_moved, windows)


def _happen(site: _Site, case: WatchCase, draw: np.random.Generator) -> tuple[_Truth, tuple[Finding, ...], float, int]:
    """Simulate one event until one window after it is found, then restore the site.

    Returns the truth, the findings, the time until found, and the number of steps.
    """
    position_m = site.position_m.copy()
    truth: _Truth = _begin(site, case, draw)
    findings: tuple[Finding, ...] = ()
    passed_s, took = 0.0, 0
    most = _LASTS_WINDOWS
    if case.event == "slow":
        most = round(2.0 * case.size_m / _SLOW_MPS / _WINDOW_S)
    apart_m = site.position_m - position_m
    while took < most and not findings:
        if case.event == "slow":
            part = min((took + 1) * _WINDOW_S * _SLOW_MPS / case.size_m, 1.0)
            site.position_m = position_m + part * apart_m
        site.run_step()
        took += 1
        passed_s += _WINDOW_S
        findings = site.watch.findings
    if findings:  # use the findings of a window that shows the whole event
        site.run_step()
        findings = site.watch.findings or findings
    site.position_m = position_m
    site.late_m[:] = 0.0
    return truth, findings, passed_s, took


def _begin(site: _Site, case: WatchCase, draw: np.random.Generator) -> _Truth:
    """Begin the event. Returns the findings of a perfect watch."""
    n = len(site.position_m)
    if case.event in {"moved", "two moved", "slow"}:
        movers = draw.choice(n, 2 if case.event == "two moved" else 1, replace=False).tolist()
        for anchor in movers:
            direction = draw.standard_normal(site.layout.dimensions)
            site.position_m[anchor, : len(direction)] += case.size_m * direction / np.linalg.norm(direction)
        return {("moved", (anchor + 1,)) for anchor in movers}
    if case.event == "delay":
        anchor = int(draw.integers(n))
        site.late_m[(site.first == anchor) | (site.second == anchor)] = case.size_m
        return {("delay", (anchor + 1,))}
    if case.event == "link":
        pairs: Integers = np.array([draw.choice(np.flatnonzero(~site.is_missing))])
    else:
        low, high = site.position_m[:, :2].min(axis=0), site.position_m[:, :2].max(axis=0)
        pairs = _crossing(site, draw.uniform(low, high))
        while not len(pairs):
            pairs = _crossing(site, draw.uniform(low, high))
    site.late_m[pairs] = case.size_m if case.event == "link" else draw.uniform(*_DOOR_LATE_M, len(pairs))
    return {("link", (int(site.first[pair]) + 1, int(site.second[pair]) + 1)) for pair in pairs.tolist()}


def _crossing(site: _Site, person_m: Array) -> Integers:
    """Pairs whose line of sight passes near a person."""
    start, end = site.position_m[site.first, :2], site.position_m[site.second, :2]
    along = end - start
    part = np.clip(np.einsum("pd,pd->p", person_m - start, along) / np.einsum("pd,pd->p", along, along), 0.0, 1.0)
    return np.flatnonzero(np.linalg.norm(start + part[:, None] * along - person_m, axis=1) < _DOOR_REACH_M)


def striking_windows(layout: SurveyLayout, window_s: float, alarm: float, windows: int, seed: int) -> int:
    """Number of windows that are significant with white noise alone."""
    draw = np.random.default_rng(seed)
    position_m = layout.position_m
    n = len(position_m)
    first, second = np.triu_indices(n, 1)
    m = len(first)
    std_m = _STAMP_S * SPEED_OF_LIGHT_MPS / math.sqrt(window_s / (n * SLOT_S))
    pairs = pairs_of(position_m, first, second, layout.dimensions, np.full(m, std_m), np.zeros(m))
    found = 0
    for start in range(0, windows, _CHUNK):
        count = min(_CHUNK, windows - start)
        of_tx = draw.standard_normal((count, n))
        noise = math.sqrt(0.5) * draw.standard_normal((count, m)) + 0.5 * (of_tx[:, first] + of_tx[:, second])
        found += int(is_significant(pairs, std_m * noise, alarm).sum())
    return found
