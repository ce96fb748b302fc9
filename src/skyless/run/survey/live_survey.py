"""A survey while stamps come in: what is known so far, its newest results, and the watch once the site is surveyed.

No I/O and no clock: times are passed in, ``now_s`` by one clock that does not go back.
"""

from collections import deque
from collections.abc import Callable, Iterator
from math import dist
from pathlib import Path
from typing import Final, Literal
from zlib import crc32

import msgspec
from msgspec import Struct
from msgspec.structs import asdict, replace

from skyless.core.air.site_pages import MAX_COORDINATE_M
from skyless.core.errors import SkylessError, writing
from skyless.core.site import FloorPlanSite, Site
from skyless.files import replace_files
from skyless.run.mqtt.messages import (
    StampsMessage,
    SurveyFactsMessage,
    SurveyMessage,
    SurveyProgress,
    WatchFinding,
    WatchMessage,
)
from skyless.run.process import Log
from skyless.site.file.check import Limits, check_site, image_size
from skyless.site.file.load import load_site, with_values
from skyless.site.survey.explain import Finding, PhaseWatch
from skyless.site.survey.facts import (
    Facts,
    PairBlock,
    PairRanges,
    Survey,
    SurveyRecord,
    baseline,
    encode_record,
    read_record,
    record_path,
)
from skyless.site.survey.legs import AnchorLeg
from skyless.site.survey.pair_ranger import PairRanger, StepTable
from skyless.site.survey.solve import delay_changes_ticks, surveyed_site, surveyed_text
from skyless.site.survey.watch import AnchorWatch, Change, with_changes

NO_DATA_S: Final = 5.0
"""Without stamps for this time a result is out of date."""

PRESENT_S: Final = 10.0
"""An anchor of which nothing came for longer is missing."""

ADOPTION_S: Final = 2.0
"""Stamps of this time after a placement are not used: anchors adopt it one after the other."""

_RESULTS_KEPT: Final = 64  # a user saves the result that is on the page, while newer ones are made

_MAX_BACKLOG_S: Final = 60.0
"""A message that is later than this against others of its sender shows that a clock was set, not that it waited."""

_SHOWN_PAIRS_PER_S: Final = 200

_LAG_S: Final = 30.0
"""For up to twice this time the quickest message counts: a host's clock that was set back is noticed after it."""

_MAX_WAITING_BLOCKS: Final = 100_000  # a minute of a site with 50 anchors
_MAX_WAITING_LEGS: Final = 100_000

FactsOf = Callable[[Site], Facts]
"""What is known of a site without a user's help."""

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
        self.begun = 0  # how often ranges have begun again: a result of ranges from before does not count
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

    # What comes in

    def add_stamps(self, message: StampsMessage, now_s: float) -> None:
        """Process what an anchor has received of others. Stamps of anchors that the site has not are dropped."""
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

    def add_leg(self, leg: AnchorLeg, now_s: float) -> None:
        """Process a reception that was relayed."""
        if leg.sender in self._known and leg.receiver in self._known and not now_s < self._pause_until_s:
            self._add(leg, now_s)

    def set_facts(self, facts: Facts) -> None:
        """Replace what is known. Facts of anchors that the site has not are dropped."""
        known = self._known
        gauge = facts.gauge
        named = set() if gauge is None else {gauge.origin, gauge.x_axis, gauge.left} - {None}
        self.facts = replace(
            facts,
            heights_m={anchor: one for anchor, one in facts.heights_m.items() if anchor in known},
            tapes=tuple(one for one in facts.tapes if {one.a, one.b} <= known and one.a != one.b),
            points={anchor: one for anchor, one in facts.points.items() if anchor in known},
            sketch_m={anchor: one for anchor, one in facts.sketch_m.items() if anchor in known},
            delays=tuple(one for one in facts.delays if one.anchor in known),
            gauge=gauge if named <= known else None,
        )

    # Results

    def ranges(self) -> PairRanges:
        """All ranges so far, with all anchors of the site."""
        found = self._ranger.ranges()
        return replace(found, anchors=tuple(sorted(self._known)))

    def finish(self) -> PairRanger:
        """Nothing more comes: what has come since the last full second counts as well. What makes the ranges."""
        self._ranger.finish()
        return self._ranger

    def steps(self) -> StepTable:
        """The ranges in the order of time, for ``change_of``."""
        return self._ranger.steps.table()

    def use_since(self, change: Change) -> None:
        """Drop the ranges from before a change, and the results computed from them."""
        self._ranger.drop_before(change.since_s)
        self._changes += (change,)
        self._shown = None
        self._results.clear()

    def add_result(self, survey: Survey, ranges: PairRanges) -> None:
        """Keep a result of the present ranges. The oldest of many is dropped."""
        self.serial += 1
        self._results[self.serial] = (with_changes(survey, self._changes, ranges.duration_s), ranges)
        if len(self._results) > _RESULTS_KEPT:
            del self._results[next(iter(self._results))]

    def result(self, serial: int) -> tuple[Survey, PairRanges] | None:
        """A result by its number, with the ranges that it was made of, or None if it is no longer kept."""
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

    # What goes out

    def state(self, now_s: float) -> State:
        """Whether stamps come, and whether there is a result."""
        if self._newest_s is None or now_s - self._newest_s > NO_DATA_S:
            return "no data"
        return "surveyed" if self._results else "collecting"

    def message(self, now_s: float, unix_s: float, file: str | None) -> SurveyMessage:
        """All of it for those who watch."""
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
        """What the watch saw when it was last advanced, or None if too few anchors have positions for a watch."""
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
        """Let the watch look at the ranges that have come. A striking window of a large site takes it a second.

        It may run in a thread while all else is called, but not twice at once.
        """
        if self._watch is not None:
            self._watch.advance(now_s)

    def restart_ranges(self) -> None:
        """Forget all ranges and results: an anchor is where it was not before, or antenna delays are others."""
        self.begun += 1
        self._known = {anchor.id for anchor in self.site.all_anchors}
        self._ranger = PairRanger(on_block=self._on_block)
        self._shown = None
        self._changes = ()
        self._results.clear()

    # Within

    def _shown_ranges(self, now_s: float) -> PairRanges:
        """Ranges for a message: those of 1225 pairs take half a second, and are made again every six."""
        if self._shown is None or not 0.0 <= now_s - self._shown[1] < len(self._shown[0].pairs) / _SHOWN_PAIRS_PER_S:
            self._shown = self._ranger.ranges(), now_s
        return self._shown[0]

    def _add(self, leg: AnchorLeg, now_s: float) -> None:
        self._newest_s = self._heard_s[leg.sender] = self._heard_s[leg.receiver] = now_s
        self._ranger.add(leg.sender, leg.receiver, leg.tx_ticks, leg.rx_ticks, leg.t_s)
        if self._watch is not None and leg.carrier_phase_cycles is not None:
            self._watch.waiting_legs.append(leg)

    def _sent_s(self, anchor: int, unix_s: float, now_s: float) -> float:
        """When a message was sent: by its sender's clock, less what the quickest of its messages shows that to be off.

        A message may have waited behind others, and hosts' clocks differ.
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
        """Watch the anchors that have positions, if these are enough to say anything."""
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
    """Since then."""
    least_s: float
    """In the time before."""


class _Watched:
    """A watch, the ranges that it has not looked at yet, and what it saw last."""

    def __init__(self, watch: AnchorWatch) -> None:
        self.waiting: deque[PairBlock] = deque(maxlen=_MAX_WAITING_BLOCKS)
        self.waiting_legs: deque[AnchorLeg] = deque(maxlen=_MAX_WAITING_LEGS)
        self.seen: tuple[Literal["learning", "watching", "no data"], tuple[Finding, ...], int] = ("no data", (), 0)
        self._watch, self._phases = watch, PhaseWatch()

    def advance(self, now_s: float) -> None:
        """Look at what is waiting."""
        watch = self._watch
        while self.waiting:
            watch.add(self.waiting.popleft())
        watch.advance(now_s)
        while self.waiting_legs:
            self._phases.add(self.waiting_legs.popleft())
        found = watch.findings
        named = {anchor for one in found if one.kind != "link" for anchor in one.anchors}  # what stamps show is enough
        found += tuple(one for one in self._phases.findings if not named & set(one.anchors))
        self.seen = watch.state, found, watch.pairs


# A survey into the files of a site: the site's own, the record next to it, and the image of the floor.

_NEAR_M: Final = 1e-3
_ENDINGS: Final = {b"\x89PNG": ".png"}


class FloorImage(Struct, frozen=True):
    """Where the image of the floor lies, and its bytes, or None for that of the site file."""

    plan: FloorPlanSite
    image: bytes | None


class Saved(Struct, frozen=True):
    """The site after a survey."""

    site: Site
    record: SurveyRecord
    written: tuple[Path, ...] = ()


def saved_without_file(site: Site, survey: Survey, ranges: PairRanges, unix_s: float) -> Saved:
    """The site after a survey, where there is no file to write.

    Raises:
        SkylessError: the result is no valid site.
    """
    placed = surveyed_site(site, survey)
    check_site(placed, Path("the survey's result"))
    return Saved(placed, _record(site, survey, ranges, unix_s))


def record_of(file: Path | None, site: Site, log: Log) -> SurveyRecord | None:
    """The record of the survey that a site file comes from. Without one the watch learns what is usual."""
    if file is None or not record_path(file).exists():
        return None
    try:
        record = read_record(record_path(file))
    except SkylessError as error:
        log(f"not used: {error}")
        return None
    if is_record_of(record, site):
        return record
    log(f"not used: {record_path(file)} is of other positions than those in {file}")
    return None


def is_record_of(record: SurveyRecord, site: Site) -> bool:
    """Whether a site still has the positions that a survey gave it."""
    known = {anchor.id for anchor in site.all_anchors}
    placed = {anchor.id: (anchor.x_m, anchor.y_m) for anchor in site.anchors}
    found = {
        one.id: (one.x_m, one.y_m)
        for one in record.survey.anchors
        if one.determined and one.id in known and one.x_m is not None and one.y_m is not None
    }
    return record.site_id == site.id and all(
        anchor in placed and dist(placed[anchor], place_m) < _NEAR_M for anchor, place_m in found.items()
    )


def save_survey(
    file: Path, survey: Survey, ranges: PairRanges, unix_s: float, floor: FloorImage | None = None
) -> Saved:
    """Write a result into a site's file, and its record next to it. The file before is kept under another name.

    Raises:
        SkylessError: a file cannot be read or written, or the result is no valid site.
    """
    site = load_site(file)
    record, kept = _record(site, survey, ranges, unix_s), kept_path(file)
    image: dict[Path, bytes] = {}
    with writing(file):
        text = surveyed_text(file.read_bytes().decode("utf-8-sig"), survey, site, file)
        if floor is not None:
            image_name, image = _floor_image(file, site, floor)
            if image_name is not None:
                values = asdict(replace(floor.plan, image=image_name))
                text = with_values(text, {}, {"floor_plan": values}, file, "the floor plan")
        files = {kept: file.read_bytes(), record_path(file): encode_record(record), file: text.encode()}
        replace_files(image | files)
    return Saved(load_site(file), record, (file, record_path(file), kept, *image))


def _record(site: Site, survey: Survey, ranges: PairRanges, unix_s: float) -> SurveyRecord:
    return SurveyRecord(site.name, site.id, unix_s, ranges, survey, delay_changes_ticks(site, survey))


def kept_path(file: Path) -> Path:
    """Where the file before a survey is kept: ``NAME.before-survey-1.toml``, or the next number that is free."""
    number = 1
    while (kept := file.with_name(f"{file.stem}.before-survey-{number}{file.suffix}")).exists():
        number += 1
    return kept


def _floor_image(file: Path, site: Site, floor: FloorImage) -> tuple[str | None, dict[Path, bytes]]:
    """Name of the image in the site file, or None without one, and the file to write if the image is new."""
    present = None if site.floor_plan is None else site.floor_plan.image
    if floor.image is None or image_size(floor.image) is None:
        return present, {}
    if present is not None and (file.parent / present).read_bytes() == floor.image:
        return present, {}
    path = file.with_name(f"{file.stem}.floor{_ENDINGS.get(floor.image[:4], '.jpg')}")
    if path.exists() and path.read_bytes() != floor.image:
        path = path.with_stem(f"{path.stem}-{crc32(floor.image):08x}")
    return path.name, {path: floor.image}


# Whether facts on MQTT or from a page can be computed with.

MAX_FACTS: Final = 10_000
"""Heights, tapes, points and the like, each."""

_COORDINATE: Final = Limits(-MAX_COORDINATE_M, MAX_COORDINATE_M, "metres")
_LENGTH: Final = Limits(0, MAX_COORDINATE_M, "metres", above=True)
_STD: Final = Limits(0, 100, "metres")
_POSITIVE_STD: Final = Limits(0, 100, "metres", above=True)


class BadFactsError(ValueError):
    """What is wrong with the facts that somebody has sent, or with a request to save."""


def check_facts(message: SurveyFactsMessage) -> None:
    """Check that facts can be computed with. Raises BadFactsError, which names field, value and what would be right."""
    facts = message.facts
    if facts.tags:
        raise BadFactsError(f"facts.tags has {len(facts.tags)} entries; what tags received comes from recordings only")
    for name in ("heights_m", "tapes", "points", "sketch_m", "delays"):
        count = len(getattr(facts, name))
        if count > MAX_FACTS:
            raise BadFactsError(f"facts.{name} has {count} entries; at most {MAX_FACTS} are allowed")
    for path, value, limits in _limited(message):
        if not limits.contains(value):
            raise BadFactsError(f"{path} is {value:g}; it should be {limits}")
    for index, tape in enumerate(facts.tapes):
        if tape.a == tape.b:
            raise BadFactsError(f"facts.tapes[{index}] is from anchor {tape.a} to itself; it should be between two")
    if facts.gauge is not None:
        named = [anchor for anchor in msgspec.structs.astuple(facts.gauge) if anchor is not None]
        if len(set(named)) < len(named):
            listed = ", ".join(map(str, named))
            raise BadFactsError(f"facts.gauge names anchors {listed}; origin, x axis and left should be different ones")


def _limited(message: SurveyFactsMessage) -> Iterator[tuple[str, float, Limits]]:
    """Every number of metres: its path, itself, and what is allowed."""
    facts, plan = message.facts, message.floor_plan
    for anchor, height_m in facts.heights_m.items():
        yield f"facts.heights_m of anchor {anchor}", height_m, _COORDINATE
    for index, tape in enumerate(facts.tapes):
        yield f"facts.tapes[{index}].distance_m", tape.distance_m, _LENGTH
        yield f"facts.tapes[{index}].std_m", tape.std_m, _POSITIVE_STD
    for name in ("points", "sketch_m"):
        for anchor, point in getattr(facts, name).items():
            for axis, value in zip("xyz", point, strict=True):
                if value is not None:
                    yield f"facts.{name} of anchor {anchor}, {axis}", value, _COORDINATE
    for index, delay in enumerate(facts.delays):
        yield f"facts.delays[{index}].delay_m", delay.delay_m, _COORDINATE
        yield f"facts.delays[{index}].std_m", delay.std_m, _POSITIVE_STD
    yield from _stds(facts)
    if plan is not None:
        yield "floor_plan.width_m", plan.width_m, _LENGTH
        yield "floor_plan.x_m", plan.x_m, _COORDINATE
        yield "floor_plan.y_m", plan.y_m, _COORDINATE


def _stds(facts: Facts) -> Iterator[tuple[str, float, Limits]]:
    for name in ("height_std_m", "point_std_m", "sketch_std_m"):
        yield f"facts.{name}", getattr(facts, name), _POSITIVE_STD
    for name in ("delay_std_m", "common_delay_std_m", "pair_std_m"):
        yield f"facts.{name}", getattr(facts, name), _STD
