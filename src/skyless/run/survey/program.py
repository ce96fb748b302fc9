"""``skyless survey`` at a running site: collects anchors' stamps, publishes and saves results, watches the anchors.

``LiveSurvey`` is the survey itself: no I/O and no clock, ``now_s`` is by one monotonic clock.
"""

import asyncio
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final, Literal

from msgspec import UNSET, Struct
from msgspec.structs import replace

from skyless.core.errors import SkylessError
from skyless.core.site import Site, is_same_but_placed, site_digest
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import (
    PlacementMessage,
    RequestMessage,
    SiteMessage,
    StampsMessage,
    SurveyFactsMessage,
    SurveyMessage,
    SurveySaveMessage,
    WatchFinding,
    WatchMessage,
)
from skyless.run.process import Log, every, keep, outlasting, reader, together
from skyless.run.survey.checked_facts import BadFactsError, check_facts
from skyless.site.file.load import load_site
from skyless.site.survey.explain import Finding, PhaseWatch
from skyless.site.survey.facts import Facts, PairBlock, PairRanges, Survey
from skyless.site.survey.legs import AnchorLeg
from skyless.site.survey.pair_ranger import PairRanger
from skyless.site.survey.solve import run_survey
from skyless.site.survey.surveyed_site import (
    FloorImage,
    Saved,
    SurveyRecord,
    baseline,
    delay_differences_m,
    record_of,
    save_survey,
    saved_without_file,
)
from skyless.site.survey.watch import AnchorWatch, Change, change_of, with_changes

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
            self.ranger.forget(message.anchor)
        t_s = self._sent_s(message.anchor, message.unix_s, now_s)
        for stamp in message.stamps:
            if stamp.anchor in self._known:
                ticks, phase_cycles = (stamp.tx_ticks, stamp.rx_ticks), stamp.carrier_phase_cycles
                self._add(AnchorLeg(stamp.anchor, message.anchor, *ticks, t_s, phase_cycles), now_s)

    # Results

    def ranges(self) -> PairRanges:
        """Return all ranges so far, with all anchors of the site."""
        return replace(self.ranger.ranges(), anchors=tuple(sorted(self._known)))

    def use_since(self, change: Change) -> None:
        """Drop the ranges before a change, and the results computed from them."""
        self.ranger.drop_before(change.since_s)
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
        # Ranges of 1225 pairs take half a second, so they are renewed only every six seconds.
        if self._shown is None or not 0.0 <= now_s - self._shown[1] < len(self._shown[0].pairs) / _SHOWN_PAIRS_PER_S:
            self._shown = self.ranger.ranges(), now_s
        ranges = self._shown[0]
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
            pairs=ranges.pairs,
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
        self.ranger = PairRanger(on_block=self._on_block)
        self._shown = None
        self._changes = ()
        self._results.clear()

    # Helpers

    def _add(self, leg: AnchorLeg, now_s: float) -> None:
        self._newest_s = self._heard_s[leg.sender] = self._heard_s[leg.receiver] = now_s
        self.ranger.add(leg.sender, leg.receiver, leg.tx_ticks, leg.rx_ticks, leg.t_s)
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
        self.waiting: deque[PairBlock] = deque(maxlen=100_000)  # a minute of a site with 50 anchors
        self.waiting_legs: deque[AnchorLeg] = deque(maxlen=100_000)
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


NAME: Final = "survey"
"""The program's name on MQTT: a site has one survey program."""

LEASE_S: Final = 15.0
_REQUEST_S: Final = 5.0  # each request for stamps is repeated at this interval, before its lease ends

_UPDATE_S: Final = 1.0
_PAIRS_PER_S: Final = 400  # pairs published per second: larger sites publish less often

_COST: Final = 5.0  # the next result begins after at least this multiple of the time that the last one took

_SETTLED_S: Final = 60.0
_SETTLED_UPDATE_S: Final = 5.0  # after a minute of data results change little, and are computed less often

_EARLIER_KEPT: Final = 32  # earlier sites that a placement names

_MAX_LOGGED: Final = 100

QUIET_S: Final = 10.0
"""A serving program publishes a survey at least this often."""

_ENDED_S: Final = 3.0 * QUIET_S  # an earlier program without a message for this time has ended

_SAME_SIZE: Final = 0.25  # a finding whose size has changed by a smaller share than this is not logged again


class SurveySettings(Struct, frozen=True):
    """Settings of a survey program."""

    site_id: int
    site: Site | None = None
    """None means the site on MQTT."""
    file: Path | None = None
    """The site's file, which is written on request."""
    serves: bool = True
    """Whether it serves the site. Otherwise it only collects, beside a program that serves: it computes, publishes and
    saves nothing."""


class SurveyNode:
    """The survey program of one site, with stamps from MQTT."""

    def __init__(self, settings: SurveySettings, facts_of: FactsOf, address: MqttAddress, log: Log) -> None:
        """``facts_of``: facts about a site known without a user's help."""
        self.live: LiveSurvey | None = None  # None before the site is known
        self.problems = 0  # messages that could not be read
        self.saved: Saved | None = None
        self._settings, self._facts_of, self._log = settings, facts_of, log
        self._given: SurveyFactsMessage | None = None
        self._running: Site | None = None  # the site of the anchors, as they publish it
        self._placement: PlacementMessage | None = None  # the newest on MQTT
        self._image: bytes | None = None
        self._facts_changed = False
        self._solving: asyncio.Task[None] | None = None
        self._watching: asyncio.Task[None] | None = None
        self._next_solve_s = 0.0
        self._next_publish_s = 0.0
        self._watch_published: tuple[WatchMessage, float] | None = None
        self._findings_log = FindingsLog()
        self._logged_state = ""
        self._logged: set[str] = set()  # lines that are logged once
        self._precedence = Precedence(time.time())
        self._name = NAME if settings.serves else f"{NAME}-{secrets.token_hex(4)}"
        self.link = Link(address, self._name, site=settings.site_id, kind=NAME)
        self._subscribe(self.link)
        if settings.site is not None:
            self._begin(settings.site)

    async def run(self) -> None:
        """Serve until cancelled."""
        await outlasting(keep(self.link, self._log), self._work())  # the last messages are still sent

    async def _work(self) -> None:
        try:
            await together(every(_UPDATE_S, self.update), every(_REQUEST_S, self._request))
        finally:
            for task in (self._solving, self._watching):
                if task is not None:
                    task.cancel()
            self._withdraw()

    def _withdraw(self) -> None:
        """End the lease, and clear the topics that are retained only while this program runs."""
        link, site_id = self.link, self._settings.site_id
        link.publish(topics.request_topic(site_id), RequestMessage(self._name, (), 0.0), qos=1)
        if self._settings.serves and not self._waits():
            for topic in (topics.survey_topic(site_id), topics.watch_topic(site_id)):
                link.publish(topic, b"", qos=1, retain=True)

    # Input

    def _subscribe(self, link: Link) -> None:
        site_id = self._settings.site_id
        link.on_state.append(lambda connected: self._request() if connected else None)
        read: list[tuple[str, type[Struct], Callable[..., None], int]] = [
            (topics.site_topic(site_id), SiteMessage, self._on_site, 1),
            (topics.stamps_topic(site_id, topics.EVERY_NODE), StampsMessage, self._on_stamps, 0),
        ]
        if self._settings.serves:
            read += [
                (topics.survey_facts_topic(site_id), SurveyFactsMessage, self._on_facts, 1),
                (topics.survey_save_topic(site_id), SurveySaveMessage, self._on_save, 1),
                (topics.placement_topic(site_id), PlacementMessage, self._on_placement, 1),
                (topics.survey_topic(site_id), SurveyMessage, self._on_survey, 1),
            ]
            link.subscribe(topics.floor_plan_topic(site_id), self._on_image)
        for topic, kind, act, qos in read:
            link.subscribe(topic, reader(kind, act, self._on_wrong), qos)

    def _on_wrong(self) -> None:
        self.problems += 1

    def _request(self) -> None:
        message = RequestMessage(self._name, (), LEASE_S, stamps=True)
        self.link.publish(topics.request_topic(self._settings.site_id), message, qos=1)

    def _on_site(self, message: SiteMessage) -> None:
        self._running = message.site
        live = self.live
        if live is None:
            self._begin(message.site)
        elif site_digest(message.site) == site_digest(live.site):
            return
        elif self._settings.file is not None:
            self._log(f"the anchors run with another site than {self._settings.file}: its positions or delays differ")
        else:
            self._log("the anchors run with another site than before: the survey begins again")
            self._begin(message.site)

    def _on_stamps(self, message: StampsMessage) -> None:
        if self.live is not None:
            self.live.add_stamps(message, time.monotonic())

    def _on_facts(self, message: SurveyFactsMessage) -> None:
        try:
            check_facts(message)
        except BadFactsError as error:
            self.problems += 1
            self._log_once(f"survey: facts are ignored: {error}")
            return
        self._given = message
        if self.live is not None:
            self.live.facts = message.facts
            self._facts_changed = True
            self._next_solve_s = self._next_publish_s = 0.0

    def _on_survey(self, message: SurveyMessage) -> None:
        if self._precedence.add(message, time.monotonic()):
            site_id = self._settings.site_id
            self._log(f"survey: another survey program serves site {site_id}: this one waits for its end")
            self._forget(topics.survey_topic, topics.watch_topic)

    def _waits(self) -> bool:
        """Whether another program serves the site, so that this one only collects."""
        return self._precedence.waits(time.monotonic())

    def _on_image(self, _topic: str, payload: bytes) -> None:
        self._image = payload or None

    def _on_placement(self, message: PlacementMessage) -> None:
        if message != self._placement:
            self._forget(topics.placement_topic)
        self._placement = message

    def _forget(self, *given: Callable[[int], str]) -> None:
        """Stop repeating the own messages on topics that another program now publishes."""
        for topic in given:
            self.link.forget(topic(self._settings.site_id))

    def _begin(self, site: Site) -> None:
        record = record_of(self._settings.file, site, self._log)
        try:
            facts = self._facts_of(site) if self._given is None else self._given.facts
        except SkylessError as error:  # options name anchors that are not in the site on MQTT
            self._log(f"survey: {error}")
            facts = Facts()
        self.live = LiveSurvey(site, facts, record)
        self._next_solve_s = 0.0

    # Results

    @property
    def delays_m(self) -> dict[int, float]:
        """By how much half an anchor's delays are larger at the site to be surveyed than at the anchors as they run."""
        if self.live is None or self._running is None:
            return {}
        return delay_differences_m(self._running, self.live.site)

    def update(self) -> None:
        """Start computing another result if one is due, and publish what is due."""
        live, now_s, unix_s = self.live, time.monotonic(), time.time()
        if live is None or not self._settings.serves or self._waits():
            return
        is_due = now_s >= self._next_solve_s and (live.state(now_s) != "no data" or self._facts_changed)
        if is_due and (self._solving is None or self._solving.done()):
            self._solving = asyncio.ensure_future(self._make_result(live))
        self._log_state(live, now_s)
        if self._watching is None or self._watching.done():
            self._watching = asyncio.ensure_future(self._advance_watch(live))
        watch = live.watch_message(now_s, unix_s)
        if watch is not None:
            self._log_findings(live, watch)
        self._publish(self.link, live, now_s, unix_s, watch)

    async def _make_result(self, live: LiveSurvey) -> None:
        """Compute one result, in a thread so that the event loop goes on."""
        self._facts_changed = False
        ranges, facts, begun = live.ranges(), live.facts, live.begun
        if not ranges.pairs:
            return
        begin_s = time.monotonic()
        try:
            change = await asyncio.to_thread(change_of, live.ranger.steps.table(), facts)
            if change is not None and live.begun == begun:
                self._log(f"survey: {change.sentence}; only ranges since then are used")
                live.use_since(change)
                ranges = live.ranges()
            survey = await asyncio.to_thread(run_survey, ranges, facts)
        except SkylessError as error:
            live.error = str(error)
            return
        except Exception as error:  # noqa: BLE001 - whatever it is, the next attempt may succeed
            live.error = f"no result: {error!r}"
            self._log(live.error)
            return
        finally:
            took_s = time.monotonic() - begin_s
            pause_s = _SETTLED_UPDATE_S if ranges.duration_s > _SETTLED_S else _UPDATE_S
            if not self._facts_changed:
                self._next_solve_s = time.monotonic() + max(pause_s, _COST * took_s) - 0.5 * _UPDATE_S
        if self.live is live and live.facts is facts and live.begun == begun:
            live.error = None
            live.add_result(survey, ranges)

    async def _advance_watch(self, live: LiveSurvey) -> None:
        """Let the watch process new ranges, in a thread so that the event loop goes on."""
        try:
            await asyncio.to_thread(live.advance_watch, time.monotonic())
        except Exception as error:  # noqa: BLE001 - whatever it is, the survey goes on
            self._log_once(f"watch: {error!r}")

    def _publish(self, link: Link, live: LiveSurvey, now_s: float, unix_s: float, watch: WatchMessage | None) -> None:
        site_id, file = self._settings.site_id, self._settings.file
        if now_s >= self._next_publish_s:
            found = live.message(now_s, unix_s, None if file is None else str(file))
            message = replace(found, by=self._precedence.name)
            link.publish(topics.survey_topic(site_id), message, qos=1, retain=True)
            pause_s = QUIET_S if message.state == "no data" else max(_UPDATE_S, len(message.pairs) / _PAIRS_PER_S)
            self._next_publish_s = now_s + pause_s - 0.5 * _UPDATE_S
        if watch is not None:
            published = self._watch_published
            if published is None or now_s - published[1] >= QUIET_S or _content(watch) != _content(published[0]):
                self._watch_published = watch, now_s
                link.publish(topics.watch_topic(site_id), watch, qos=1, retain=True)

    def _log_state(self, live: LiveSurvey, now_s: float) -> None:
        state = live.state(now_s)
        if state != self._logged_state:
            if state == "no data" and self._logged_state:
                self._log("survey: no stamps come from the anchors any more")
                self._next_publish_s = 0.0
            elif state != "no data" and self._logged_state in ("", "no data"):
                self._log("survey: stamps come from the anchors")
            self._logged_state = state

    def _log_findings(self, live: LiveSurvey, watch: WatchMessage) -> None:
        """Log new findings. An anchor that has moved makes the earlier ranges useless for another survey."""
        lines, has_moved = self._findings_log.update(watch.findings)
        for line in lines:
            self._log(f"watch: {line}")
        if has_moved:
            live.restart_ranges()

    def _log_once(self, line: str) -> None:
        if line not in self._logged and len(self._logged) < _MAX_LOGGED:
            self._logged.add(line)
            self._log(line)

    # Saving

    def _on_save(self, message: SurveySaveMessage) -> None:
        live = self.live
        if live is None or self._waits():
            return
        try:
            self.save(message.serial)
        except SkylessError as error:
            live.error = f"not saved: {error}"
            self._log(f"survey: {live.error}")
        self._next_publish_s = 0.0
        self.update()

    def save(self, serial: int | None = None) -> Saved:
        """Use a result, by default the newest: write the site file, and let the anchors adopt it.

        Raises SkylessError: there is no such result, or it cannot be used.
        """
        live = self.live
        if live is None:
            raise SkylessError("the site is not known yet")
        number = live.serial if serial is None else serial
        kept = live.result(number)
        if kept is None:
            raise SkylessError(f"result {number} is not there; the newest is {live.serial}")
        survey, ranges = kept
        if not any(anchor.determined for anchor in survey.anchors):
            raise SkylessError(f"result {number} determines no anchor")
        file, before, running = self._settings.file, live.site, self._running
        if running is not None and site_digest(running) != site_digest(before):
            raise SkylessError(f"the anchors run with another site than {file or 'before'}: start them with that file")
        unix_s = time.time()
        if file is None:
            saved = saved_without_file(before, survey, ranges, unix_s)
        else:
            present = load_site(file)
            if site_digest(present) != site_digest(before) or not is_same_but_placed(before, present):
                raise SkylessError(f"{file} is not the site that was surveyed: it has been changed meanwhile")
            plan = None if self._given is None else self._given.floor_plan
            saved = save_survey(file, survey, ranges, unix_s, None if plan is None else FloorImage(plan, self._image))
        self._place(live, before, saved, number)
        return saved

    def _place(self, live: LiveSurvey, before: Site, saved: Saved, serial: int) -> None:
        """Publish the new site for the anchors, then survey and watch it."""
        earlier: tuple[str, ...] = ()
        old = self._placement
        if old is not None and site_digest(old.site) == site_digest(before):
            earlier = (old.before, *old.earlier)[:_EARLIER_KEPT]
        unix_s = time.time()
        self._placement = PlacementMessage(
            unix_s, site_digest(before), replace(saved.site, outline_m=UNSET, alarms=UNSET), earlier
        )
        self.link.publish(topics.placement_topic(self._settings.site_id), self._placement, qos=1, retain=True)
        self._running = None  # until the anchors publish it
        self.saved = saved
        live.place(saved.site, saved.record, serial, time.monotonic(), unix_s)
        written = "".join(f", {path} written" for path in saved.written)
        self._log(f"survey: saved{written}")
        if saved.record.survey.assumed_heights is not None:
            self._log(f"survey: {saved.record.survey.assumed_heights}")


class Precedence:
    """Decides which of two survey programs at one site waits, so that only one saves on the page's request. No I/O."""

    def __init__(self, unix_s: float) -> None:
        """``unix_s``: when this program started."""
        self.name = f"{1e3 * unix_s:014.0f}-{secrets.token_hex(4)}"  # programs that started earlier have lesser names
        self._newest: tuple[str, float] | None = None
        """Name of an earlier program, and the time in its newest message."""
        self._heard_s: float | None = None  # when an earlier program was last seen to run

    def add(self, message: SurveyMessage, now_s: float) -> bool:
        """Add a survey message from MQTT. Returns True if it is the first to show that this program has to wait.

        One message proves nothing, as the broker may have retained it; a second, different one does.
        """
        if message.by == "" or message.by >= self.name:
            return False
        before, self._newest = self._newest, (message.by, message.unix_s)
        if before is None or before[0] != message.by or before == self._newest:
            return False
        waited = self.waits(now_s)
        self._heard_s = now_s
        return not waited

    def waits(self, now_s: float) -> bool:
        """Whether an earlier program serves the site."""
        return self._heard_s is not None and now_s - self._heard_s < _ENDED_S


class FindingsLog:
    """Findings that were logged and still hold."""

    def __init__(self) -> None:
        self._logged: dict[tuple[str, tuple[int, ...]], WatchFinding] = {}

    def update(self, findings: Iterable[WatchFinding]) -> tuple[list[str], bool]:
        """Return lines for what is new or over, and whether an anchor has newly moved or changed its delay."""
        lines: list[str] = []
        present = {(str(one.kind), one.anchors): one for one in findings}
        for key, one in present.items():
            logged = self._logged.get(key)
            if logged is not None and abs(one.size_m - logged.size_m) < _SAME_SIZE * abs(logged.size_m):
                present[key] = logged
            elif logged is None or one.sentence != logged.sentence:
                lines.append(one.sentence)
        lines += [f"over: {one.sentence}" for key, one in self._logged.items() if key not in present]
        has_moved = any(kind in ("moved", "delay") for kind, _ in present.keys() - self._logged.keys())
        self._logged = present
        return lines, has_moved


def _content(message: WatchMessage) -> object:
    """Contents of a watch message that are compared: all but its times and sizes."""
    return message.state, message.pairs, [(one.kind, one.anchors, one.sentence) for one in message.findings]
