"""The watch of a site's anchors: windows of ranges, what has changed in each, and what is found in two of three."""

import math
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from typing import Final, Literal

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from scipy.special import chdtri

from skyless.kernels.arrays import Array, Integers, Mask
from skyless.survey.ranges import PairBlock
from skyless.survey.watch.causes import Pairs, evidence, weight_of
from skyless.survey.watch.explain import Explanation, Part, explain, is_significant, nothing
from skyless.survey.watch.finding import Finding, sentence_of, silent_link
from skyless.survey.watch.history import HistorySettings, RangeHistory

_LASTING: Final = 1e-3
"""A finding lasts while what it says has more evidence than chance gives with this probability."""

_SLOW_DRIFT: Final = 2.0
"""Drift of the usual range from the first one, as a multiple of that of one window from the usual range."""

_REGULAR: Final = 0.8
"""Share of windows in which a pair must have had ranges for their absence to be a finding."""
_KNOWN_WINDOWS: Final = 12

_FARTHEST_M: Final = 1e5
"""Longest range, delays included."""

_MEDIAN_BLOCKS: Final = 3
"""Blocks from which on their median counts, which short obstacles do not change."""
_MEDIAN_VARIANCE: Final = math.pi / 2.0

_JUMP_WINDOWS: Final = 1000
"""Blocks that are older than that many windows show that the clock was set back."""


class WatchSettings(Struct, frozen=True):
    """How changes are noticed."""

    window_s: float = 10.0
    steps: int = 1
    """A window ends this many times within its length: windows overlap if it is more than 1."""
    needed: int = 2
    of: int = 3
    """Something is found when it is seen in ``needed`` of the last ``of`` windows."""
    false_alarm: float = 1e-6
    """Probability that noise and drift alone make the changes of a window significant."""
    learning_windows: int = 12
    """Windows before the watch begins, for pairs without a given range."""
    silent_windows: int = 3
    """Windows without a range after which a link is blocked."""
    grace_s: float = 3.0
    """How long after its end a window waits for blocks."""
    history: HistorySettings = HistorySettings()


FAST_SETTINGS: Final = WatchSettings(
    window_s=0.1,
    steps=2,
    needed=1,
    of=1,
    false_alarm=1e-7,
    learning_windows=200,
    silent_windows=20,
    grace_s=0.0,
    history=HistorySettings(usual_windows=600, drift_windows=4, drift_floor_m=0.0, learns_drift=False),
)
"""For ranges that do not drift: finds 10 cm within 0.15 s. Real rooms do drift."""


class _Held(Struct):
    """A finding, and whether the last windows support it."""

    finding: Finding
    or_else: str | None
    lost: deque[bool]


class _Window(Struct, frozen=True):
    """What was seen in one window, with anchors by identifier."""

    start_s: float
    parts: tuple[Part, ...]


class AnchorWatch:
    """Compares the ranges between anchors with what they usually are.

    It reads no clock: ``t_s`` of the blocks and ``advance`` are on one clock, whichever. What cannot be used is counted
    in ``counters``: ``unknown-anchor``, ``impossible-block``, ``late-block``.
    """

    def __init__(
        self,
        position_m: Mapping[int, tuple[float, float, float]],
        dimensions: Literal[2, 3] = 2,
        baseline_m: Mapping[tuple[int, int], float] | None = None,
        settings: WatchSettings | None = None,
    ) -> None:
        """Watch these anchors.

        ``position_m``: of each anchor. ``dimensions``: 2 where anchors can only move horizontally, or heights cannot
        be seen. ``baseline_m``: ranges with delays when the site was surveyed, by pairs; learned where missing.
        """
        self.counters: Counter[str] = Counter()
        self._settings = settings or WatchSettings()
        self._ids = sorted(position_m)
        self._number = {anchor: number for number, anchor in enumerate(self._ids)}
        self._position_m = np.array([position_m[anchor] for anchor in self._ids], np.float64).reshape(-1, 3)
        self._dimensions = dimensions
        self._history = RangeHistory(self._settings.history)
        self._row: dict[tuple[int, int], int] = {}
        self._first: list[int] = []
        self._second: list[int] = []
        self._silent: list[int] = []
        """Windows without a range since each pair's last one, while both anchors had others."""
        self._pending: dict[int, dict[int, list[PairBlock]]] = {}
        self._open: int | None = None
        """Number of the oldest step that is not done."""
        self._steps: deque[dict[int, list[PairBlock]]] = deque(maxlen=self._settings.steps)
        self._windows: deque[_Window] = deque(maxlen=self._settings.of)
        self._held: list[_Held] = []
        self._blocked: dict[int, float] = {}
        """Pairs that are silent, and since when."""
        self._done = 0
        self._has_data = False
        for (a, b), range_m in (baseline_m or {}).items():
            if a in self._number and b in self._number and a != b and math.isfinite(range_m):
                self._pair_row(min(a, b), max(a, b), range_m)

    @property
    def state(self) -> Literal["learning", "watching", "no data"]:
        """``learning`` until some pair's usual range is known well enough."""
        if not self._has_data:
            return "no data"
        return "watching" if bool(self._is_known().any()) else "learning"

    @property
    def pairs(self) -> int:
        """Number of pairs that are compared."""
        return int(self._is_known().sum())

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What has changed and still is; the largest first, silent links last."""
        held = sorted((one.finding for one in self._held), key=lambda one: (one.kind == "check", -abs(one.size_m)))
        silent = [
            silent_link(self._ids[self._first[row]], self._ids[self._second[row]], since_s)
            for row, since_s in sorted(self._blocked.items())
        ]
        return (*held, *silent)

    def add(self, block: PairBlock) -> None:
        """Add the ranges of a pair, in any order within ``grace_s``."""
        if block.a not in self._number or block.b not in self._number or block.a == block.b:
            self.counters["unknown-anchor"] += 1
            return
        is_possible = abs(block.mean_m) < _FARTHEST_M and 0.0 <= block.std_m < _FARTHEST_M and block.exchanges > 0
        if not is_possible or not math.isfinite(block.t_s):
            self.counters["impossible-block"] += 1
            return
        step = math.floor(block.t_s / self._step_s)
        if self._open is None or step < self._open - _JUMP_WINDOWS:
            self._open = step
            self._pending.clear()
        if step < self._open:
            self.counters["late-block"] += 1
            return
        row = self._pair_row(min(block.a, block.b), max(block.a, block.b))
        if block.exchanges > 1 and block.std_m > 0.0:
            self._history.add_noise(row, block.std_m**2 * block.exchanges, block.exchanges)
        self._pending.setdefault(step, {}).setdefault(row, []).append(block)
        self.advance(block.t_s)

    def advance(self, now_s: float) -> None:
        """Conclude the windows that are over."""
        if self._open is None or not math.isfinite(now_s):
            return
        last = math.floor((now_s - self._settings.grace_s) / self._step_s) - 1
        while self._open <= last:
            waiting = min(self._pending, default=None)
            if waiting is None or waiting > self._open + 2 * self._settings.steps:
                self._has_data = False
                self._open = last + 1 if waiting is None else min(waiting, last + 1)
                self._steps.clear()
                continue
            self._conclude(self._open, self._pending.pop(self._open, {}))
            self._open += 1

    def accept(self, anchors: Iterable[int] | None = None) -> None:
        """Learn again what is usual: for all pairs, or for those of some anchors. Their findings end.

        A site that was surveyed again gets a new watch instead, as positions differ.
        """
        chosen = set(self._ids if anchors is None else anchors)
        rows = np.array([self._ids[a] in chosen or self._ids[b] in chosen for a, b in self._ends()], dtype=np.bool_)
        self._history.restart(rows)
        self._held = [one for one in self._held if not chosen & set(one.finding.anchors)]
        self._windows.clear()
        for row in [row for row in self._blocked if rows[row]]:
            del self._blocked[row]
            self._history.presence[row] = 0.0

    @property
    def _step_s(self) -> float:
        return self._settings.window_s / self._settings.steps

    def _ends(self) -> list[tuple[int, int]]:
        return list(zip(self._first, self._second, strict=True))

    def _pair_row(self, a: int, b: int, given_m: float | None = None) -> int:
        row = self._row.get((a, b))
        if row is None:
            row = self._row[a, b] = self._history.add_pair(given_m)
            self._first.append(self._number[a])
            self._second.append(self._number[b])
            self._silent.append(0)
        return row

    def _is_known(self) -> Mask:
        least = min(self._settings.learning_windows, self._settings.history.usual_windows // 2)
        return np.asarray(self._history.windows >= least)

    def _conclude(self, step: int, blocks: dict[int, list[PairBlock]]) -> None:
        """See what has changed in the window that ends with this step."""
        self._steps.append(blocks)
        if len(self._steps) < self._settings.steps:
            return
        self._done += 1
        self._has_data = any(self._steps)
        start_s = (step + 1) * self._step_s - self._settings.window_s
        range_m, exchanges = self._ranges()
        is_present = np.isfinite(range_m)
        is_held = self._touched(one.finding for one in self._held)
        is_touched = is_held.copy()
        known = np.flatnonzero(is_present & self._is_known())
        if len(known):
            drift_m = self._history.drift_m()
            seen = self._compare(known, range_m, exchanges, drift_m)
            slow = self._compare_slowly(known, drift_m)
            parts = [self._named(part) for part in seen.parts]
            covered = {anchor for part in parts for anchor in part.anchors}
            parts += [part for part in map(self._named, slow) if not covered & set(part.anchors)]
            is_touched |= self._touched(map(self._named, seen.parts))
            self._windows.append(_Window(start_s, tuple(parts)))
            self._update(known, seen, {self._ids[end] for row in known.tolist() for end in self._ends()[row]})
        is_expected = self._note_silence(is_present, start_s)
        is_displaced = self._touched(one.finding for one in self._held if one.finding.kind != "link")
        self._history.add_window(range_m, ~is_touched, ~is_displaced, is_expected)

    def _ranges(self) -> tuple[Array, Array]:
        """The window's range of each pair, NaN where there is none, and its exchanges as far as they make the noise."""
        range_m, exchanges = np.full(len(self._row), np.nan), np.zeros(len(self._row))
        gathered: dict[int, list[PairBlock]] = {}
        for one in self._steps:
            for row, blocks in one.items():
                gathered.setdefault(row, []).extend(blocks)
        for row, blocks in gathered.items():
            count = sum(block.exchanges for block in blocks)
            if len(blocks) >= _MEDIAN_BLOCKS:
                range_m[row] = float(np.median([block.mean_m for block in blocks]))
                exchanges[row] = count / _MEDIAN_VARIANCE
            else:
                range_m[row] = sum(block.mean_m * block.exchanges for block in blocks) / count
                exchanges[row] = count
        return range_m, exchanges

    def _compare(self, known: Integers, range_m: Array, exchanges: Array, drift_m: Array) -> Explanation:
        """The window against the usual ranges."""
        history, overlap = self._history, self._settings.steps
        reference = 1.0 + np.minimum(overlap / history.windows[known], 1.0)  # its noise, too, is in the change
        white_m = np.sqrt(np.maximum(history.noise_m2[known], 1e-8) / exchanges[known] * reference)
        pairs = self._pairs(known, white_m, drift_m[known] * np.sqrt(reference))
        change_m = range_m[known] - history.usual_m[known]
        if bool(is_significant(pairs, change_m, self._settings.false_alarm)):
            return explain(pairs, change_m)
        return nothing(pairs, change_m)

    def _compare_slowly(self, known: Integers, drift_m: Array) -> tuple[Part, ...]:
        """The usual ranges against the first ones: what has changed too slowly to be seen in a window."""
        if not self._settings.history.learns_drift:
            return ()
        change_m = self._history.usual_m[known] - self._history.first_m[known]
        is_old = np.isfinite(change_m)
        if not is_old.any():
            return ()
        rows = known[is_old]
        pairs = self._pairs(rows, np.full(len(rows), 1e-4), _SLOW_DRIFT * drift_m[rows])
        if not bool(is_significant(pairs, change_m[is_old], self._settings.false_alarm)):
            return ()
        return explain(pairs, change_m[is_old]).parts

    def _pairs(self, rows: Integers, white_m: Array, drift_m: Array) -> Pairs:
        first, second = np.array(self._first)[rows], np.array(self._second)[rows]
        weight = weight_of(first, second, len(self._ids), white_m, drift_m)
        return Pairs(self._position_m, first, second, self._dimensions, weight)

    def _named(self, part: Part) -> Part:
        """With identifiers of anchors."""
        return replace(part, anchors=tuple(self._ids[number] for number in part.anchors))

    def _touched(self, found: Iterable[Finding | Part]) -> Mask:
        """Pairs that one of these concerns, whose usual range stays as it is."""
        rows = np.zeros(len(self._row), np.bool_)
        for one in found:
            for pair, row in self._row.items():
                is_link = one.kind == "link"
                rows[row] |= pair == one.anchors if is_link else bool(set(pair) & set(one.anchors))
        return rows

    def _update(self, known: Integers, seen: Explanation, present: set[int]) -> None:
        """Find what was seen in enough windows, and end what is not seen any more."""
        newest = self._windows[-1]
        for part in newest.parts:
            found = self._confirmed(part)
            if found is not None:
                self._hold(found)
        for one in self._held:
            if not present & set(one.finding.anchors):
                continue
            supported = any(set(part.anchors) & set(one.finding.anchors) for part in newest.parts)
            one.lost.append(not (supported or self._lasts(one.finding, known, seen)))
        self._held = [one for one in self._held if sum(one.lost) < self._settings.needed]

    def _confirmed(self, part: Part) -> _Held | None:
        """The part as a finding, if enough of the last windows have the same, or something at the same anchors."""
        windows = list(self._windows)
        same = [one for one in windows if any(_key(other) == _key(part) for other in one.parts)]
        if len(same) < self._settings.needed:
            common, same = set(part.anchors), [windows[-1]]
            kinds: set[str] = {part.kind}
            for window in reversed(windows[:-1]):
                for other in window.parts:
                    if common & set(other.anchors) and len(same) < self._settings.needed:
                        common &= set(other.anchors)
                        kinds.add(other.kind)
                        same.append(window)
                        break
            if len(same) < self._settings.needed:
                return None
            part = _compromise(part, common, kinds)
        since_s = min(window.start_s for window in same)
        sentence = sentence_of(part.kind, part.anchors, part.size_m, or_else=part.or_else)
        finding = Finding(part.kind, part.anchors, part.size_m, part.std_m, since_s, sentence)
        return _Held(finding, part.or_else, deque(maxlen=self._settings.of))

    def _hold(self, found: _Held) -> None:
        """Add a finding, or bring one at the same anchors up to date."""
        new = found.finding
        for number, one in enumerate(self._held):
            old = one.finding
            if not set(old.anchors) & set(new.anchors):
                continue
            if _key(old) == _key(new) or old.kind == "check":
                self._held[number] = _Held(replace(new, since_s=min(old.since_s, new.since_s)), found.or_else, one.lost)
                return
            if new.kind == "check":
                return
            if {old.kind, new.kind} == {"moved", "delay"} and old.anchors == new.anchors:
                if found.or_else is None or new.kind == "moved":
                    self._held[number] = _Held(replace(new, since_s=old.since_s), found.or_else, one.lost)
                return
        self._held.append(found)

    def _lasts(self, finding: Finding, known: Integers, seen: Explanation) -> bool:
        """Whether there is still evidence for a finding in what else was seen leaves unexplained."""
        first, second = np.array(self._first)[known], np.array(self._second)[known]
        pairs = Pairs(self._position_m, first, second, self._dimensions, seen.weight)
        found, dof = evidence(pairs, seen.weight, seen.weighted_m)
        n = len(self._ids)
        numbers = [self._number[anchor] for anchor in finding.anchors]
        ends = np.isin(first, numbers).astype(np.int64) + np.isin(second, numbers)
        links = (2 * n + np.flatnonzero(ends == len(numbers) if finding.kind == "link" else ends)).tolist()
        causes = {
            "moved": numbers,
            "delay": [n + number for number in numbers],
            "link": links,
            "check": [*numbers, *(n + number for number in numbers), *links],
        }[finding.kind]
        causes = [cause for cause in causes if dof[cause] > 0]
        return any(found[cause] > chdtri(dof[cause], _LASTING / len(causes)) for cause in causes)

    def _note_silence(self, is_present: Mask, start_s: float) -> Mask:
        """Find links that are silent while both anchors are received by others; returns where ranges are expected."""
        heard = {end for row in np.flatnonzero(is_present).tolist() for end in self._ends()[row]}
        expected = np.zeros(len(is_present), np.bool_)
        for row, (a, b) in enumerate(self._ends()):
            if is_present[row]:
                self._silent[row] = 0
                self._blocked.pop(row, None)
                expected[row] = True
            elif a in heard and b in heard:
                self._silent[row] += 1
                expected[row] = row not in self._blocked
                is_regular = self._history.presence[row] >= _REGULAR and self._history.windows[row] >= _KNOWN_WINDOWS
                if self._silent[row] == self._settings.silent_windows and is_regular:
                    self._blocked[row] = start_s - (self._silent[row] - 1) * self._step_s
            else:
                self._silent[row] = 0  # an anchor that is away blocks no link
        return expected


def _key(one: Part | Finding) -> tuple[str, tuple[int, ...]]:
    return one.kind, one.anchors


def _compromise(part: Part, anchors: set[int], kinds: set[str]) -> Part:
    """What windows that differ have in common."""
    if len(anchors) == 1 and kinds == {"moved", "delay"}:
        if part.kind == "moved":
            return replace(part, or_else="delay")
        return replace(part, or_else="moved")
    return Part("check", tuple(sorted(anchors)), part.size_m, None)
