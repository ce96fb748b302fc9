"""``skyless survey`` at a running site: collects anchors' stamps, publishes and saves results, watches the anchors."""

import asyncio
import secrets
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from msgspec import UNSET, Struct
from msgspec.structs import replace

from skyless.core.errors import SkylessError
from skyless.core.site import Site, is_same_but_placed, site_digest
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
from skyless.run.mqtt.topics import (
    EVERY_NODE,
    floor_plan_topic,
    placement_topic,
    request_topic,
    site_topic,
    stamps_topic,
    survey_facts_topic,
    survey_save_topic,
    survey_topic,
    watch_topic,
)
from skyless.run.process import Log, every, keep, outlasting, reader, together
from skyless.run.survey.checked_facts import BadFactsError, check_facts
from skyless.run.survey.live_survey import FactsOf, LiveSurvey
from skyless.site.file.load import load_site
from skyless.site.survey.facts import Facts, PairRanges, Survey
from skyless.site.survey.surveyed_site import (
    FloorImage,
    Saved,
    delay_differences_m,
    record_of,
    save_survey,
    saved_without_file,
)
from skyless.site.survey.watch import change_of

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

Solve = Callable[[PairRanges, Facts], Survey]


class SurveySettings(Struct, frozen=True):
    """Settings of a survey program."""

    site_id: int
    site: Site | None = None
    """None means the site on MQTT."""
    file: Path | None = None
    """The site's file, which is written on request."""
    serves: bool = True
    """Whether it serves the site. Otherwise it only collects, beside a program that serves: it computes, publishes and
    saves nothing.
    """


class SurveyNode:
    """The survey program of one site, with stamps from MQTT."""

    def __init__(
        self,
        settings: SurveySettings,
        facts_of: FactsOf,
        solve: Solve,
        address: MqttAddress,
        log: Log,
    ) -> None:
        """``facts_of``: facts about a site known without a user's help. ``solve``: ``survey.solve.run_survey``."""
        self.live: LiveSurvey | None = None  # None before the site is known
        self.problems = 0  # messages that could not be read
        self.saved: Saved | None = None
        self._settings, self._facts_of, self._solve, self._log = settings, facts_of, solve, log
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
        link.publish(request_topic(site_id), RequestMessage(self._name, (), 0.0), qos=1)
        if self._settings.serves and not self._waits():
            for topic in (survey_topic(site_id), watch_topic(site_id)):
                link.publish(topic, b"", qos=1, retain=True)

    # Input

    def _subscribe(self, link: Link) -> None:
        site_id = self._settings.site_id
        link.on_state.append(lambda connected: self._request() if connected else None)
        topics: list[tuple[str, type[Struct], Callable[..., None], int]] = [
            (site_topic(site_id), SiteMessage, self._on_site, 1),
            (stamps_topic(site_id, EVERY_NODE), StampsMessage, self._on_stamps, 0),
        ]
        if self._settings.serves:
            topics += [
                (survey_facts_topic(site_id), SurveyFactsMessage, self._on_facts, 1),
                (survey_save_topic(site_id), SurveySaveMessage, self._on_save, 1),
                (placement_topic(site_id), PlacementMessage, self._on_placement, 1),
                (survey_topic(site_id), SurveyMessage, self._on_survey, 1),
            ]
            link.subscribe(floor_plan_topic(site_id), self._on_image)
        for topic, kind, act, qos in topics:
            link.subscribe(topic, reader(kind, act, self._on_wrong), qos)

    def _on_wrong(self) -> None:
        self.problems += 1

    def _request(self) -> None:
        message = RequestMessage(self._name, (), LEASE_S, stamps=True)
        self.link.publish(request_topic(self._settings.site_id), message, qos=1)

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
            self.live.set_facts(message.facts)
            self._facts_changed = True
            self._next_solve_s = self._next_publish_s = 0.0

    def _on_survey(self, message: SurveyMessage) -> None:
        if self._precedence.add(message, time.monotonic()):
            site_id = self._settings.site_id
            self._log(f"survey: another survey program serves site {site_id}: this one waits for its end")
            self._forget(survey_topic, watch_topic)

    def _waits(self) -> bool:
        """Whether another program serves the site, so that this one only collects."""
        return self._precedence.waits(time.monotonic())

    def _on_image(self, _topic: str, payload: bytes) -> None:
        self._image = payload or None

    def _on_placement(self, message: PlacementMessage) -> None:
        if message != self._placement:
            self._forget(placement_topic)
        self._placement = message

    def _forget(self, *topics: Callable[[int], str]) -> None:
        """Stop repeating the own messages on topics that another program now publishes."""
        for topic in topics:
            self.link.forget(topic(self._settings.site_id))

    def _begin(self, site: Site) -> None:
        """Start surveying a site."""
        record = record_of(self._settings.file, site, self._log)
        try:
            facts = self._facts_of(site) if self._given is None else self._given.facts
        except SkylessError as error:  # options name anchors that are not in the site on MQTT
            self._log(f"survey: {error}")
            facts = Facts()
        self.live = LiveSurvey(site, facts, record)
        self.live.set_facts(facts)
        self._next_solve_s = 0.0

    # Results

    def final_ranges(self) -> PairRanges:
        """Return the final ranges, computed with the antenna delays of the site to be surveyed.

        The anchors may run with other delays. Call this only once the site is known.
        """
        assert self.live is not None
        self.live.finish()
        ranges = self.live.ranges()
        if self._running is None:
            return ranges
        return ranges.without_delays(delay_differences_m(self._running, self.live.site))

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
            change = await asyncio.to_thread(change_of, live.steps(), facts, self._solve)
            if change is not None and live.begun == begun:
                self._log(f"survey: {change.sentence}; only ranges since then are used")
                live.use_since(change)
                ranges = live.ranges()
            survey = await asyncio.to_thread(self._solve, ranges, facts)
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
            link.publish(survey_topic(site_id), message, qos=1, retain=True)
            pause_s = QUIET_S if message.state == "no data" else max(_UPDATE_S, len(message.pairs) / _PAIRS_PER_S)
            self._next_publish_s = now_s + pause_s - 0.5 * _UPDATE_S
        if watch is not None:
            published = self._watch_published
            if published is None or now_s - published[1] >= QUIET_S or _content(watch) != _content(published[0]):
                self._watch_published = watch, now_s
                link.publish(watch_topic(site_id), watch, qos=1, retain=True)

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

        Raises:
            SkylessError: there is no such result, or it cannot be used.
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
            floor = None if plan is None else FloorImage(plan, self._image)
            saved = save_survey(file, survey, ranges, unix_s, floor)
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
        self.link.publish(placement_topic(self._settings.site_id), self._placement, qos=1, retain=True)
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
    findings = [(one.kind, one.anchors, one.sentence) for one in message.findings]
    return message.state, message.pairs, findings
