"""Watch of a site's anchors: changes of ranges in each window, and findings seen in two of three windows."""

import math
import warnings
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from typing import Final, Literal

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from scipy.special import chdtri, ndtri

from skyless.core.arrays import Array, Integers, Mask
from skyless.site.survey.explain import (
    Explanation,
    Finding,
    Pairs,
    Part,
    evidence,
    explain,
    is_significant,
    nothing,
    pairs_of,
    sentence_of,
)
from skyless.site.survey.facts import Facts, PairBlock, PairRange, PairRanges, Survey
from skyless.site.survey.legs import MEDIAN_VARIANCE, STD_OVER_MAD
from skyless.site.survey.pair_ranger import PairRanger, StepTable
from skyless.site.survey.solve import run_survey

_USUAL_WINDOWS: Final = 60  # windows in the median that is the usual range
_DRIFT_WINDOWS: Final = 360
_MIN_DRIFT_M: Final = 0.02
_GIVEN_WINDOWS: Final = 30  # a given range counts as this many windows
_PRIOR_DIFFERENCES: Final = 4
_PRIOR_DRIFT_M: Final = 0.03  # expected drift of a pair, which counts as _PRIOR_DIFFERENCES observed differences
_MIN_LAGS: Final = 6  # least number of known windows per lag between compared ones
_NOISE_MEMORY: Final = 2000.0  # exchanges that the noise estimate remembers
_NOISE_JUMP: Final = 9.0  # largest ratio of one block's noise variance to that of the blocks before
_PRESENCE_MEMORY: Final = 60.0  # windows over which the regularity of a pair's ranges is averaged


class RangeHistory:
    """Usual range, drift and noise of all pairs, indexed by pair number."""

    def __init__(self) -> None:
        self._usual = np.full((0, _USUAL_WINDOWS), np.nan)
        self._used = np.zeros(0, np.int64)
        """Windows that have gone into each row of ``_usual``."""
        self._values = np.full((0, _DRIFT_WINDOWS), np.nan)
        self._windows = 0
        self.usual_m = np.zeros(0)
        """Shape (m,): the usual range; NaN where unknown."""
        self.noise_m2 = np.zeros(0)
        """Shape (m,): variance of one exchange."""
        self._noise_exchanges = np.zeros(0)
        self.first_m = np.zeros(0)
        """Shape (m,): the given range, or the first median over ``_USUAL_WINDOWS``; NaN before."""
        self.presence = np.zeros(0)
        """Shape (m,): share of the windows with both anchors in which the pair had a range."""

    def __len__(self) -> int:
        return len(self._usual)

    @property
    def windows(self) -> Array:
        """Shape (m,): windows in each usual range."""
        return np.minimum(self._used, _USUAL_WINDOWS).astype(np.float64)

    def add_pair(self, given_m: float | None = None) -> int:
        """Add a pair and return its number. ``given_m``: its range by the survey."""
        first_m, used = (np.nan, 0) if given_m is None else (given_m, _GIVEN_WINDOWS)
        row = np.full((1, _USUAL_WINDOWS), np.nan)
        row[0, :used] = first_m
        self._usual = np.concatenate([self._usual, row])
        self._used = np.append(self._used, used)
        self._values = np.concatenate([self._values, np.full((1, _DRIFT_WINDOWS), np.nan)])
        self.usual_m = np.append(self.usual_m, first_m)
        self.noise_m2 = np.append(self.noise_m2, 0.0)
        self._noise_exchanges = np.append(self._noise_exchanges, 0.0)
        self.first_m = np.append(self.first_m, first_m)
        self.presence = np.append(self.presence, 1.0)
        return len(self._usual) - 1

    def add_noise(self, pair: int, variance_m2: float, exchanges: int) -> None:
        """Update a pair's noise from a block. ``variance_m2``: of one exchange."""
        known = self._noise_exchanges[pair]
        if known > 0.0:
            variance_m2 = min(variance_m2, _NOISE_JUMP * self.noise_m2[pair])
        total = known + exchanges
        self.noise_m2[pair] += (variance_m2 - self.noise_m2[pair]) * exchanges / total
        self._noise_exchanges[pair] = min(total, _NOISE_MEMORY)

    def add_window(self, range_m: Array, is_usable: Mask, is_drifting: Mask, is_expected: Mask) -> None:
        """Add the ranges of a window, shape (m,), NaN where there is none.

        ``is_usable``: pairs without a change, whose usual range is updated. ``is_drifting``: pairs whose changes may
        count as drift. ``is_expected``: pairs for which a missing range lowers ``presence``.
        """
        self._values[:, self._windows % _DRIFT_WINDOWS] = np.where(is_drifting, range_m, np.nan)
        self._windows += 1
        is_present = np.isfinite(range_m)
        rows = np.flatnonzero(is_present & is_usable)
        self._usual[rows, self._used[rows] % _USUAL_WINDOWS] = range_m[rows]
        self._used[rows] += 1
        if len(rows):
            self.usual_m[rows] = np.nanmedian(self._usual[rows], axis=1)
        is_full = np.isnan(self.first_m) & (self._used >= _USUAL_WINDOWS)
        self.first_m[is_full] = self.usual_m[is_full]
        self.presence[is_expected] += (is_present[is_expected] - self.presence[is_expected]) / _PRESENCE_MEMORY

    def drift_m(self) -> Array:
        """Standard deviation of each pair's drift about its usual range, shape (m,).

        From differences of windows up to half the median's length apart: a step affects few of them, and the median
        itself follows slower drift.
        """
        length = _DRIFT_WINDOWS
        known = min(self._windows, length)
        lag = max(min(_USUAL_WINDOWS // 2, known // _MIN_LAGS), 1)
        newest = np.arange(self._windows - known + lag, self._windows)
        apart = np.abs(self._values[:, newest % length] - self._values[:, (newest - lag) % length])
        count = np.isfinite(apart).sum(axis=1)
        scale_m2 = np.zeros(len(self))
        rows = np.flatnonzero(count)
        if len(rows):
            scale_m2[rows] = (STD_OVER_MAD * np.nanmedian(apart[rows], axis=1)) ** 2 / 2.0
        learned_m2 = (count * scale_m2 + _PRIOR_DIFFERENCES * _PRIOR_DRIFT_M**2) / (count + _PRIOR_DIFFERENCES)
        return np.asarray(np.sqrt(np.maximum(learned_m2, _MIN_DRIFT_M**2)))

    def restart(self) -> None:
        """Forget the usual ranges and learn them again."""
        self._used[:] = 0
        self._usual[:] = np.nan
        self.usual_m[:] = self.first_m[:] = np.nan
        self._values[:] = np.nan


_LASTING: Final = 1e-3  # a finding lasts while its evidence exceeds what chance gives with this probability
_SLOW_DRIFT: Final = 2.0
"""Ratio of the drift between first and usual range to the drift between usual range and one window."""

_REGULAR: Final = 0.8  # share of windows in which a pair must have had ranges for their absence to be a finding
_KNOWN_WINDOWS: Final = 12

_FARTHEST_M: Final = 1e5  # longest range, delays included
_MEDIAN_BLOCKS: Final = 3  # blocks needed to use their median, which short obstacles do not change

_JUMP_WINDOWS: Final = 1000  # a block older than this many windows means that the clock was set back

GRACE_S: Final = 3.0
"""How long a window waits for blocks after its end."""
_NEEDED: Final = 2
_OF: Final = 3  # a change becomes a finding when seen in ``_NEEDED`` of the last ``_OF`` windows
_FALSE_ALARM: Final = 1e-6  # probability that noise and drift alone make a window significant
_SILENT_WINDOWS: Final = 3  # windows without a range after which a link is blocked


class _Held(Struct):
    """A finding, and which of the last windows did not support it."""

    finding: Finding
    or_else: str | None
    lost: deque[bool]


class _Window(Struct, frozen=True):
    start_s: float
    parts: tuple[Part, ...]


class AnchorWatch:
    """Compares the ranges between anchors with their usual values.

    Reads no clock: ``t_s`` of the blocks and ``advance`` must share one clock. Unusable blocks are counted in
    ``counters``: ``unknown-anchor``, ``impossible-block``, ``late-block``.
    """

    def __init__(
        self,
        position_m: Mapping[int, tuple[float, float, float]],
        dimensions: Literal[2, 3] = 2,
        baseline_m: Mapping[tuple[int, int], float] | None = None,
        *,
        window_s: float = 10.0,
        learning_windows: int = 12,
    ) -> None:
        """Watch these anchors.

        ``position_m``: of each anchor. ``dimensions``: 2 if anchors can only move horizontally, or heights are not
        observable. ``baseline_m``: ranges with delays at the time of the survey, by pair; missing ones are learned
        over ``learning_windows``, after which the pair is watched.
        """
        self.counters: Counter[str] = Counter()
        self._window_s, self._learning_windows = window_s, learning_windows
        self._ids = sorted(position_m)
        self._number = {anchor: number for number, anchor in enumerate(self._ids)}
        self._position_m = np.array([position_m[anchor] for anchor in self._ids], np.float64).reshape(-1, 3)
        self._dimensions = dimensions
        self._history = RangeHistory()
        self._row: dict[tuple[int, int], int] = {}
        """Row of each pair in the history, in the order of rows."""
        self._silent: list[int] = []
        """Windows without a range since each pair's last one, while both anchors had others."""
        self._pending: dict[int, dict[int, list[PairBlock]]] = {}
        self._open: int | None = None
        """Number of the oldest open window."""
        self._windows: deque[_Window] = deque(maxlen=_OF)
        self._held: list[_Held] = []
        self._blocked: dict[int, float] = {}
        """Silent pairs, and since when."""
        self._has_data = False
        for (a, b), range_m in (baseline_m or {}).items():
            if a in self._number and b in self._number and a != b and math.isfinite(range_m):
                self._pair_row(min(a, b), max(a, b), range_m)

    @property
    def state(self) -> Literal["learning", "watching", "no data"]:
        """``learning`` until the usual range of at least one pair is known well enough."""
        if not self._has_data:
            return "no data"
        return "watching" if bool(self._is_known().any()) else "learning"

    @property
    def pairs(self) -> int:
        """Number of watched pairs."""
        return int(self._is_known().sum())

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Current findings: the largest first, unclear ones (``check``) after them, silent links last."""
        held = sorted((one.finding for one in self._held), key=lambda one: (one.kind == "check", -abs(one.size_m)))
        silent = []
        for row, since_s in sorted(self._blocked.items()):
            a, b = list(self._row)[row]
            sentence = f"anchors {a} and {b} no longer receive each other"
            silent.append(Finding("link", (a, b), 0.0, None, since_s, sentence))
        return (*held, *silent)

    def add(self, block: PairBlock) -> None:
        """Add a block of a pair, in any order within ``GRACE_S``."""
        if block.a not in self._number or block.b not in self._number or block.a == block.b:
            self.counters["unknown-anchor"] += 1
            return
        is_possible = abs(block.mean_m) < _FARTHEST_M and 0.0 <= block.std_m < _FARTHEST_M and block.exchanges > 0
        if not is_possible or not math.isfinite(block.t_s):
            self.counters["impossible-block"] += 1
            return
        window = math.floor(block.t_s / self._window_s)
        if self._open is None or window < self._open - _JUMP_WINDOWS:
            self._open = window
            self._pending.clear()
        if window < self._open:
            self.counters["late-block"] += 1
            return
        row = self._pair_row(min(block.a, block.b), max(block.a, block.b))
        if block.exchanges > 1 and block.std_m > 0.0:
            self._history.add_noise(row, block.std_m**2 * block.exchanges, block.exchanges)
        self._pending.setdefault(window, {}).setdefault(row, []).append(block)
        self.advance(block.t_s)

    def advance(self, now_s: float) -> None:
        """Evaluate the windows that are over."""
        if self._open is None or not math.isfinite(now_s):
            return
        last = math.floor((now_s - GRACE_S) / self._window_s) - 1
        while self._open <= last:
            waiting = min(self._pending, default=None)
            if waiting is None or waiting > self._open + 2:
                self._has_data = False
                self._open = last + 1 if waiting is None else min(waiting, last + 1)
                continue
            self._conclude(self._open, self._pending.pop(self._open, {}))
            self._open += 1

    def accept(self) -> None:
        """Accept the current state: end all findings and learn the usual ranges again.

        After a new survey, use a new watch instead, as positions differ.
        """
        self._history.restart()
        self._history.presence[list(self._blocked)] = 0.0
        self._held.clear()
        self._windows.clear()
        self._blocked.clear()

    def _ends(self, rows: Integers) -> tuple[Integers, Integers]:
        """Numbers of both anchors of these rows' pairs."""
        numbers = np.array([(self._number[a], self._number[b]) for a, b in self._row], np.int64).reshape(-1, 2)[rows]
        return numbers[:, 0], numbers[:, 1]

    def _anchors_of(self, rows: Integers) -> set[int]:
        pairs = list(self._row)
        return {anchor for row in rows.tolist() for anchor in pairs[row]}

    def _pair_row(self, a: int, b: int, given_m: float | None = None) -> int:
        row = self._row.get((a, b))
        if row is None:
            row = self._row[a, b] = self._history.add_pair(given_m)
            self._silent.append(0)
        return row

    def _is_known(self) -> Mask:
        return np.asarray(self._history.windows >= min(self._learning_windows, _USUAL_WINDOWS // 2))

    def _conclude(self, window: int, blocks: dict[int, list[PairBlock]]) -> None:
        self._has_data = bool(blocks)
        start_s = window * self._window_s
        range_m, exchanges = self._ranges(blocks)
        is_present = np.isfinite(range_m)
        is_touched = self._touched(one.finding for one in self._held)
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
            self._update(known, seen, self._anchors_of(known))
        is_expected = self._note_silence(is_present, start_s)
        is_displaced = self._touched(one.finding for one in self._held if one.finding.kind != "link")
        self._history.add_window(range_m, ~is_touched, ~is_displaced, is_expected)

    def _ranges(self, gathered: dict[int, list[PairBlock]]) -> tuple[Array, Array]:
        """The window's range of each pair, NaN where there is none, and its effective number of exchanges."""
        range_m, exchanges = np.full(len(self._row), np.nan), np.zeros(len(self._row))
        for row, blocks in gathered.items():
            count = sum(block.exchanges for block in blocks)
            if len(blocks) >= _MEDIAN_BLOCKS:
                range_m[row] = float(np.median([block.mean_m for block in blocks]))
                exchanges[row] = count / MEDIAN_VARIANCE
            else:
                range_m[row] = sum(block.mean_m * block.exchanges for block in blocks) / count
                exchanges[row] = count
        return range_m, exchanges

    def _compare(self, known: Integers, range_m: Array, exchanges: Array, drift_m: Array) -> Explanation:
        history = self._history
        reference = 1.0 + np.minimum(1.0 / history.windows[known], 1.0)  # the change also has the usual range's noise
        white_m = np.sqrt(np.maximum(history.noise_m2[known], 1e-8) / exchanges[known] * reference)
        pairs = self._pairs(known, white_m, drift_m[known] * np.sqrt(reference))
        change_m = range_m[known] - history.usual_m[known]
        if bool(is_significant(pairs, change_m, _FALSE_ALARM)):
            return explain(pairs, change_m)
        return nothing(pairs, change_m)

    def _compare_slowly(self, known: Integers, drift_m: Array) -> tuple[Part, ...]:
        """Compare the usual with the first ranges, for changes too slow to show in one window."""
        change_m = self._history.usual_m[known] - self._history.first_m[known]
        is_old = np.isfinite(change_m)
        if not is_old.any():
            return ()
        rows = known[is_old]
        pairs = self._pairs(rows, np.full(len(rows), 1e-4), _SLOW_DRIFT * drift_m[rows])
        if not bool(is_significant(pairs, change_m[is_old], _FALSE_ALARM)):
            return ()
        return explain(pairs, change_m[is_old]).parts

    def _pairs(self, rows: Integers, white_m: Array, drift_m: Array) -> Pairs:
        return pairs_of(self._position_m, *self._ends(rows), self._dimensions, white_m, drift_m)

    def _named(self, part: Part) -> Part:
        return replace(part, anchors=tuple(self._ids[number] for number in part.anchors))

    def _touched(self, found: Iterable[Finding | Part]) -> Mask:
        """Mask of the pairs that these findings concern."""
        rows = np.zeros(len(self._row), np.bool_)
        for one in found:
            for pair, row in self._row.items():
                is_link = one.kind == "link"
                rows[row] |= pair == one.anchors if is_link else bool(set(pair) & set(one.anchors))
        return rows

    def _update(self, known: Integers, seen: Explanation, present: set[int]) -> None:
        """Add changes seen in enough windows as findings, and end findings that are no longer supported."""
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
        self._held = [one for one in self._held if sum(one.lost) < _NEEDED]

    def _confirmed(self, part: Part) -> _Held | None:
        """The part as a finding, if enough of the last windows show it, or other changes at the same anchors."""
        windows = list(self._windows)
        same = [one for one in windows if any(_key(other) == _key(part) for other in one.parts)]
        if len(same) < _NEEDED:
            common, same = set(part.anchors), [windows[-1]]
            kinds: set[str] = {part.kind}
            for window in reversed(windows[:-1]):
                for other in window.parts:
                    if common & set(other.anchors) and len(same) < _NEEDED:
                        common &= set(other.anchors)
                        kinds.add(other.kind)
                        same.append(window)
                        break
            if len(same) < _NEEDED:
                return None
            if len(common) == 1 and kinds == {"moved", "delay"}:
                part = replace(part, or_else="delay" if part.kind == "moved" else "moved")
            else:
                part = Part("check", tuple(sorted(common)), part.size_m, None)
        since_s = min(window.start_s for window in same)
        sentence = sentence_of(part.kind, part.anchors, part.size_m, or_else=part.or_else)
        finding = Finding(part.kind, part.anchors, part.size_m, part.std_m, since_s, sentence)
        return _Held(finding, part.or_else, deque(maxlen=_OF))

    def _hold(self, found: _Held) -> None:
        """Add a finding, or update one at the same anchors."""
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
        """Whether the changes that remain unexplained are still evidence for a finding."""
        first, second = self._ends(known)
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
        """Find links that are silent although others receive both anchors. Returns pairs with an expected range."""
        heard = self._anchors_of(np.flatnonzero(is_present))
        expected = np.zeros(len(is_present), np.bool_)
        for row, (a, b) in enumerate(self._row):
            if is_present[row]:
                self._silent[row] = 0
                self._blocked.pop(row, None)
                expected[row] = True
            elif a in heard and b in heard:
                self._silent[row] += 1
                expected[row] = row not in self._blocked
                is_regular = self._history.presence[row] >= _REGULAR and self._history.windows[row] >= _KNOWN_WINDOWS
                if self._silent[row] == _SILENT_WINDOWS and is_regular:
                    self._blocked[row] = start_s - (self._silent[row] - 1) * self._window_s
            else:
                self._silent[row] = 0  # an absent anchor is no blocked link
        return expected


def _key(one: Part | Finding) -> tuple[str, tuple[int, ...]]:
    return one.kind, one.anchors


# Detection of an anchor that was moved while its ranges were gathered: those from before and after do not fit together.
#
# All splits in time are compared. If at least two pairs of one anchor differ by more than their scatter, the difference
# is explained as in the watch; a link that was blocked for a while is no motion.

_MIN_STEPS: Final = 4  # with fewer, a change looks like the scatter of ranges
_FALSE_MOVE: Final = 1e-3
"""Probability that scatter alone makes one of all ranges and splits differ (and several have to)."""

_MIN_PAIRS: Final = 2  # pairs of one anchor whose ranges must differ
_DRIFT_FLOOR_M: Final = 0.02  # ranges in rooms wander by this much, and more slowly than one step


class Change(Struct, frozen=True):
    """A change at the anchors while ranges were gathered."""

    sentence: str
    since_s: float
    """Time from which on ranges agree."""


def change_of(table: StepTable, facts: Facts) -> Change | None:
    """The largest change of an anchor between earlier and later ranges; None if there is none."""
    steps = len(table.start_s)
    if steps < _MIN_STEPS:
        return None
    before_m, after_m, left_m = _splits(table.range_m)
    white_m2, drift_m2 = _scatter(table)
    std_m = np.sqrt(2.0 * (white_m2 + drift_m2))
    differs = np.abs(after_m - before_m) > -ndtri(_FALSE_MOVE / (2.0 * before_m.size)) * std_m
    anchors = sorted({anchor for pair in table.pairs for anchor in pair})
    ends = np.array([[anchor in pair for anchor in anchors] for pair in table.pairs])
    is_changed = (differs @ ends.astype(np.int64) >= _MIN_PAIRS).any(axis=1)
    if not is_changed.any():
        return None
    split = int(np.argmin(np.where(is_changed, left_m, np.inf)))
    part = _explained(table, before_m[split], after_m[split], white_m2, drift_m2, facts)
    if part is None:
        return None
    # The anchor may still be moving in the first step after the split, so this is left out if there is another one.
    since_s = float(table.start_s[min(split + 2, steps - 1)])
    return Change(sentence_of(part.kind, part.anchors, part.size_m, or_else=part.or_else), since_s)


def drop_moved(ranger: PairRanger, facts: Facts) -> tuple[Change, ...]:
    """Drop the ranges from before each change until the rest agree. Returns the changes."""
    found: list[Change] = []
    while (change := change_of(ranger.steps.table(), facts)) is not None:
        ranger.drop_before(change.since_s)
        found.append(change)
    return tuple(found)


def with_changes(survey: Survey, changes: tuple[Change, ...], duration_s: float) -> Survey:
    """The survey with notes on changes while its ranges were gathered, of which ``duration_s`` are left."""
    left = f"only the {duration_s:.0f} s of ranges since then are used"
    notes = tuple(f"during the survey {one.sentence}; {left}" for one in changes)
    return replace(survey, notes=(*notes, *survey.notes))


def _splits(range_m: Array) -> tuple[Array, Array, Array]:
    """Medians before and after every split, shape (k - 1, m), and the sum of absolute residuals, shape (k - 1,)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a pair may have no range on one side
        before = np.array([np.nanmedian(range_m[:split], axis=0) for split in range(1, len(range_m))])
        after = np.array([np.nanmedian(range_m[split:], axis=0) for split in range(1, len(range_m))])
    left = [
        np.nansum(np.abs(range_m[: index + 1] - before[index])) + np.nansum(np.abs(range_m[index + 1 :] - after[index]))
        for index in range(len(before))
    ]
    return before, after, np.array(left)


def _scatter(table: StepTable) -> tuple[Array, Array]:
    """Variance of a step's range from noise and from drift, shape (m,) each, robust to single changes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        white_m2 = np.nanmedian(table.variance_m2, axis=0)
        apart_m = np.nanmedian(np.abs(np.diff(table.range_m, axis=0)), axis=0)
    drift_m2 = np.maximum(np.nan_to_num(STD_OVER_MAD * apart_m) ** 2 / 2.0, _DRIFT_FLOOR_M**2)
    return np.maximum(white_m2, 1e-8), drift_m2


def _explained(
    table: StepTable, before_m: Array, after_m: Array, white_m2: Array, drift_m2: Array, facts: Facts
) -> Part | None:
    """The largest change, with identifiers of anchors; None if only links were late."""
    in_both = np.flatnonzero(np.isfinite(after_m - before_m))
    pairs = [table.pairs[row] for row in in_both]
    stds_m = np.sqrt(white_m2 + drift_m2)[in_both]
    ranges = tuple(
        PairRange(a, b, range_m, std_m, 1)
        for (a, b), range_m, std_m in zip(pairs, before_m[in_both].tolist(), stds_m.tolist(), strict=True)
    )
    everybody = tuple(sorted({anchor for pair in pairs for anchor in pair}))
    found = run_survey(PairRanges(ranges, everybody), replace(facts, tags=()))
    placed = {one.id: (one.x_m, one.y_m, one.z_m) for one in found.anchors if one.determined}
    ids = sorted(placed)
    rows = np.array([row for row, (a, b) in zip(in_both.tolist(), pairs, strict=True) if {a, b} <= placed.keys()])
    if len(ids) < 3 or not len(rows):
        return None
    first, second = (np.array([ids.index(table.pairs[row][end]) for row in rows]) for end in (0, 1))
    white_m, drift_m = (np.sqrt(2.0) * np.sqrt(one[rows]) for one in (white_m2, drift_m2))
    position_m = np.array([placed[anchor] for anchor in ids], np.float64)
    compared = pairs_of(position_m, first, second, facts.dimensions, white_m, drift_m)
    causes = [part for part in explain(compared, (after_m - before_m)[rows]).parts if part.kind != "link"]
    if not causes:
        return None
    largest = max(causes, key=lambda part: abs(part.size_m))
    return replace(largest, anchors=tuple(ids[index] for index in largest.anchors))
