"""A survey in progress: the ranges so far, the newest results, and the watch over anchors with positions.

No I/O and no clock: times are passed in, ``now_s`` by one monotonic clock.
"""

from collections import deque
from collections.abc import Callable
from typing import Final, Literal

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.site import Site
from skyless.run.mqtt.messages import StampsMessage, SurveyMessage, SurveyProgress, WatchFinding, WatchMessage
from skyless.site.survey.explain import Finding, PhaseWatch
from skyless.site.survey.facts import Facts, PairBlock, PairRanges, Survey
from skyless.site.survey.legs import AnchorLeg
from skyless.site.survey.pair_ranger import PairRanger, StepTable
from skyless.site.survey.surveyed_site import SurveyRecord, baseline
from skyless.site.survey.watch import AnchorWatch, Change, with_changes

NO_DATA_S: Final = 5.0
"""Time without stamps after which the state is "no data"."""

PRESENT_S: Final = 10.0
"""An anchor that has not been received for longer is missing."""

ADOPTION_S: Final = 2.0
"""Stamps within this time after a placement are ignored, as anchors adopt it one after the other."""

_RESULTS_KEPT: Final = 64  # a user may save the result on the page while newer ones are computed

_MAX_BACKLOG_S: Final = 60.0
"""A message that seems delayed by more than this, compared with others of its sender, shows that a clock was set."""

_SHOWN_PAIRS_PER_S: Final = 200

_LAG_S: Final = 30.0
"""The quickest message counts for up to twice this time; then a host's clock that was set back is noticed."""

_MAX_WAITING_BLOCKS: Final = 100_000  # a minute of a site with 50 anchors
_MAX_WAITING_LEGS: Final = 100_000

FactsOf = Callable[[Site], Facts]
"""Returns the facts about a site that are known without a user's help."""

State = Literal["collecting", "surveyed", "no data"]


class LiveSurvey:
    """One site's survey."""

    def __init__(self, site: Site, facts: Facts, record: SurveyRecord | None = None) -> None:
        """``record``: the survey that gave the site its positions. Without it the watch learns the usual ranges."""
        self.site, self.facts = site, facts
        self.serial = 0  # of the newest result
        self.error: str | None = None
        self.saved_serial: int | None = None
        self.saved_unix_s: float | None = None
        self.missed = 0  # stamps that anchors had to drop
        self.begun = 0  # how often ranging was restarted: results of earlier ranges do not count
        self._shown: tuple[PairRanges, float] | None = None  # the ranges in messages, and when they were made
        self._watch: _Watched | None = None
        self._results: dict[int, tuple[Survey, PairRanges]] = {}
        self._changes: tuple[Change, ...] = ()  # while ranges were gathered
        self._runs: dict[int, str] = {}
        self._heard_s: dict[int, float] = {}
        self._lags: dict[int, _Lag] = {}
        self._newest_s: float | None = None
        self._pause_until_s = float("-inf")
        self.restart_ranges()
        self._begin_watch(record)

    # Input

    def add_stamps(self, message: StampsMessage, now_s: float) -> None:
        """Process an anchor's stamps of other anchors' frames. Anchors that are not in the site are ignored."""
        if message.anchor not in self._known or now_s < self._pause_until_s:
            return
        self.missed += message.missed
        if self._runs.setdefault(message.anchor, message.run) != message.run:
            self._runs[message.anchor] = message.run
            self._ranger.forget(message.anchor)
        t_s = self._sent_s(message.anchor, message.unix_s, now_s)
        for stamp in message.stamps:
            if stamp.anchor in self._known:
                ticks, phase_cycles = (stamp.tx_ticks, stamp.rx_ticks), stamp.carrier_phase_cycles
                self._add(AnchorLeg(stamp.anchor, message.anchor, *ticks, t_s, phase_cycles), now_s)

    def set_facts(self, facts: Facts) -> None:
        """Replace the known facts. Those about anchors not in the site are dropped."""
        known = self._known
        gauge = facts.gauge
        named = set() if gauge is None else {gauge.origin, gauge.x_axis, gauge.left} - {None}
        self.facts = replace(
            facts,
            heights_m={anchor: one for anchor, one in facts.heights_m.items() if anchor in known},
            tapes=tuple(one for one in facts.tapes if {one.a, one.b} <= known and one.a != one.b),
            points={anchor: one for anchor, one in facts.points.items() if anchor in known},
            sketch_m={anchor: one for anchor, one in facts.sketch_m.items() if anchor in known},
            gauge=gauge if named <= known else None,
        )

    # Results

    def ranges(self) -> PairRanges:
        """Return all ranges so far, with all anchors of the site."""
        found = self._ranger.ranges()
        return replace(found, anchors=tuple(sorted(self._known)))

    def finish(self) -> PairRanger:
        """Finish the ranges, including those since the last full second, and return their ranger."""
        self._ranger.finish()
        return self._ranger

    def steps(self) -> StepTable:
        """Return the ranges in order of time, for ``change_of``."""
        return self._ranger.steps.table()

    def use_since(self, change: Change) -> None:
        """Drop the ranges before a change, and the results computed from them."""
        self._ranger.drop_before(change.since_s)
        self._changes += (change,)
        self._shown = None
        self._results.clear()

    def add_result(self, survey: Survey, ranges: PairRanges) -> None:
        """Keep a result of the present ranges; the oldest beyond a limit is dropped."""
        self.serial += 1
        self._results[self.serial] = (with_changes(survey, self._changes, ranges.duration_s), ranges)
        if len(self._results) > _RESULTS_KEPT:
            del self._results[next(iter(self._results))]

    def result(self, serial: int) -> tuple[Survey, PairRanges] | None:
        """Return a result by its number, with the ranges it was computed from; None if it is no longer kept."""
        return self._results.get(serial)

    def place(self, site: Site, record: SurveyRecord, serial: int, now_s: float, unix_s: float) -> None:
        """Use a result's site from now on. Ranges begin again, as the antenna delays differ."""
        self.site, self.saved_serial, self.saved_unix_s, self.error = site, serial, unix_s, None
        if self.facts.sketch_m:
            sketch = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}
            self.facts = replace(self.facts, sketch_m=sketch)
        self._pause_until_s = now_s + ADOPTION_S
        self.restart_ranges()
        self._begin_watch(record)

    # Output

    def state(self, now_s: float) -> State:
        """Whether stamps come, and whether there is a result."""
        if self._newest_s is None or now_s - self._newest_s > NO_DATA_S:
            return "no data"
        return "surveyed" if self._results else "collecting"

    def message(self, now_s: float, unix_s: float, file: str | None) -> SurveyMessage:
        """Return the state of the survey as a message."""
        newest, state = self._results.get(self.serial), self.state(now_s)
        present = {anchor for anchor, heard_s in self._heard_s.items() if now_s - heard_s <= PRESENT_S}
        ranges = self._shown_ranges(now_s)
        error = self.error
        if error is None and state == "no data":
            ago = "yet" if self._newest_s is None else f"for {now_s - self._newest_s:.0f} s"
            error = f"no stamps have come from the anchors {ago}"
        return SurveyMessage(
            unix_s=unix_s,
            serial=self.serial,
            anchors=tuple(sorted(present)),
            missing=tuple(sorted(self._known - present)),
            duration_s=ranges.duration_s,
            pairs=tuple(SurveyProgress(one.a, one.b, one.exchanges, one.range_m, one.std_m) for one in ranges.pairs),
            facts=self.facts,
            survey=None if newest is None else newest[0],
            error=error,
            saved_serial=self.saved_serial,
            saved_unix_s=self.saved_unix_s,
            file=file,
            state=state,
        )

    def watch_message(self, now_s: float, unix_s: float) -> WatchMessage | None:
        """Return what the watch saw when it last advanced; None if too few anchors have positions for a watch."""
        watched = self._watch
        if watched is None:
            return None
        state, found, pairs = watched.seen
        findings = tuple(
            WatchFinding(one.kind, one.anchors, one.size_m, one.std_m, one.since_s + unix_s - now_s, one.sentence)
            for one in found
        )
        has_data = self.state(now_s) != "no data"
        return WatchMessage(unix_s, state if has_data else "no data", findings, pairs)

    def advance_watch(self, now_s: float) -> None:
        """Let the watch process new ranges; this takes a second for a conspicuous window of a large site.

        May run in a thread parallel to everything else, but not twice at once.
        """
        if self._watch is not None:
            self._watch.advance(now_s)

    def restart_ranges(self) -> None:
        """Forget all ranges and results, because an anchor or antenna delays have changed."""
        self.begun += 1
        self._known = {anchor.id for anchor in self.site.all_anchors}
        self._ranger = PairRanger(on_block=self._on_block)
        self._shown = None
        self._changes = ()
        self._results.clear()

    # Helpers

    def _shown_ranges(self, now_s: float) -> PairRanges:
        """Ranges for a message. Those of 1225 pairs take half a second, so they are renewed only every six seconds."""
        if self._shown is None or not 0.0 <= now_s - self._shown[1] < len(self._shown[0].pairs) / _SHOWN_PAIRS_PER_S:
            self._shown = self._ranger.ranges(), now_s
        return self._shown[0]

    def _add(self, leg: AnchorLeg, now_s: float) -> None:
        self._newest_s = self._heard_s[leg.sender] = self._heard_s[leg.receiver] = now_s
        self._ranger.add(leg.sender, leg.receiver, leg.tx_ticks, leg.rx_ticks, leg.t_s)
        if self._watch is not None and leg.carrier_phase_cycles is not None:
            self._watch.waiting_legs.append(leg)

    def _sent_s(self, anchor: int, unix_s: float, now_s: float) -> float:
        """Time at which a message was sent, by the sender's clock corrected for its offset.

        The offset is that of the sender's quickest message: messages may wait, and hosts' clocks differ.
        """
        lag_s = now_s - unix_s
        lag = self._lags.get(anchor)
        if lag is None or not 0.0 <= lag_s - lag.least_s < _MAX_BACKLOG_S:
            lag = self._lags[anchor] = _Lag(now_s, lag_s, lag_s)
        elif now_s - lag.begun_s >= _LAG_S:
            lag = self._lags[anchor] = _Lag(now_s, lag_s, lag.newest_s)
        lag.newest_s = min(lag.newest_s, lag_s)
        return now_s - (lag_s - min(lag.least_s, lag.newest_s))

    def _begin_watch(self, record: SurveyRecord | None) -> None:
        """Watch the anchors that have positions, if these are enough."""
        placed = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in self.site.anchors}
        self._watch = None
        if len(placed) > 2:
            known = None if record is None else {(one.a, one.b): one.range_m for one in baseline(record).pairs}
            self._watch = _Watched(AnchorWatch(placed, self.facts.dimensions, known))

    def _on_block(self, block: PairBlock) -> None:
        if self._watch is not None:
            self._watch.waiting.append(block)


class _Lag(Struct):
    """Least difference between one sender's message times and the own clock, over the last half minute to minute."""

    begun_s: float
    newest_s: float
    """Least difference since ``begun_s``."""
    least_s: float
    """Least difference in the period before."""


class _Watched:
    """A watch, its unprocessed ranges, and its last result."""

    def __init__(self, watch: AnchorWatch) -> None:
        self.waiting: deque[PairBlock] = deque(maxlen=_MAX_WAITING_BLOCKS)
        self.waiting_legs: deque[AnchorLeg] = deque(maxlen=_MAX_WAITING_LEGS)
        self.seen: tuple[Literal["learning", "watching", "no data"], tuple[Finding, ...], int] = ("no data", (), 0)
        self._watch, self._phases = watch, PhaseWatch()

    def advance(self, now_s: float) -> None:
        """Process the waiting ranges."""
        watch = self._watch
        while self.waiting:
            watch.add(self.waiting.popleft())
        watch.advance(now_s)
        while self.waiting_legs:
            self._phases.add(self.waiting_legs.popleft())
        found = watch.findings
        named = {anchor for one in found if one.kind != "link" for anchor in one.anchors}  # their finding is enough
        found += tuple(one for one in self._phases.findings if not named & set(one.anchors))
        self.seen = watch.state, found, watch.pairs
