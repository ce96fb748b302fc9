"""Tags and ranges from recordings for a survey, and biases of another system's anchors, in bounded memory."""

import os
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from math import dist, inf, log
from os import PathLike
from pathlib import Path
from typing import Final, cast

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air.frame import Reception
from skyless.core.air.masterless_packets import Packet, PairTdoa, Point
from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.site import Site
from skyless.core.ticks import TICK_BITS, Unwrapper, to_seconds
from skyless.files import Drops, open_source
from skyless.research.calibration.options import CalibrateOptions, First, Stay
from skyless.research.foreign import datasets
from skyless.research.foreign.formats import FORMATS, Recording, format_of, open_recording
from skyless.research.replays.captures import flight_height, known_anchors, known_truth, stated_anchors
from skyless.research.replays.site import SITE_FORMAT, reception_of, recorded_site, recorded_truth
from skyless.run.masterless.pair_engine import PairEngine
from skyless.run.mqtt.messages import ReceptionsMessage, StampsMessage
from skyless.run.recordings.recording import HostClock, McapRecording, Recorded, is_mcap, tags_to_replay
from skyless.sim.evaluation.figures import EvenSample, TruthTrack
from skyless.site.anchor_names import anchor_name
from skyless.site.survey.estimate import CalibrationEstimate, Differences, estimate
from skyless.site.survey.facts import PairRanges
from skyless.site.survey.legs import AnchorLeg, LegCollector, RelayedDifferences, RelayMatcher
from skyless.site.survey.pair_ranger import PairRanger
from skyless.site.survey.walk import EPOCH_S, EpochCollector, TagEpochs
from skyless.site.tables import Truth

# Tags of a recording of ``skyless record`` that were carried around, or stood at known positions.

_TAG_STD_M: Final = 0.02
"""Standard deviation of a tag's known position, per axis."""

_OFFSET_STD_M: Final = 0.03
"""Standard deviation of each anchor's own constant at the tag that is no delay, such as constant reflections. It is
less than in a walk, as delays are to be found."""

_HEIGHT_STD_M: Final = 0.1
"""Standard deviation of the height of a tag that is carried around."""

PositionAt = Callable[[float], Point | None]
"""Position of the tag's antenna at a time of the recording; None if unknown."""


def positions_of(
    asked: CalibrateOptions, truth: Truth | None, above_m: float | None, height_m: float | None, begin_s: float
) -> PositionAt:
    """Position by time: from stays, of which the first of overlapping ones counts, else from truth that is high enough.

    Raises SkylessError: a stay has no height, and the site does not state it either.
    """
    stays_m: list[tuple[Stay, Point]] = []
    for stay in cast("Sequence[Stay]", asked.stays):
        z_m = height_m if stay.z_m is None else stay.z_m
        if z_m is None:
            raise SkylessError(f"--at {stay.x_m:g},{stay.y_m:g} lacks its height: it should be x,y,z")
        stays_m.append((stay, (stay.x_m, stay.y_m, z_m)))
    track = TruthTrack(truth)

    def position_at(time_s: float) -> Point | None:
        if stays_m:
            since_s = time_s - begin_s
            return next((position_m for stay, position_m in stays_m if stay.from_s <= since_s <= stay.to_s), None)
        at_m = track.at(time_s)
        return None if at_m is None or (above_m is not None and at_m[2] <= above_m) else at_m

    return position_at


def known_tags(
    recording: McapRecording, site: Site, asked: CalibrateOptions, truth: Truth | None
) -> tuple[TagEpochs, ...]:
    """Differences of tags while at known positions. ``truth``: from a table, in Unix time. Raises SkylessError."""
    raw = tags_to_replay(recording.summary())
    names, recorded = ", ".join(raw), recorded_truth(recording)
    if asked.tag is not None and asked.tag not in raw:
        raise ConfigurationError(asked.file, "tag", asked.tag, f"one of {names}")
    if asked.tag is None and len(raw) > 1 and not asked.recorded_truth:
        raise SkylessError(f"--tag is missing; it should name the tag whose position is known, one of {names}")
    found = []
    for tag in raw if asked.tag is None else (asked.tag,):
        epochs = walk_of(recording, site.id, tag)
        begin_s = float(epochs.t_s[0]) - EPOCH_S / 2.0
        known = positions_of(asked, truth or recorded.get(tag), asked.above_m, site.tags.height_m, begin_s)
        end_s = _end_s(epochs, begin_s, asked.first)
        found.append(at_positions(epochs, tag, lambda t_s: known(t_s) if t_s <= end_s else None))  # noqa: B023 - at once
    if not any(len(epochs.t_s) for epochs in found):
        raise SkylessError(
            "the tag was nowhere at a known position; --at, --truth or --recorded-truth should say where it was"
        )
    return tuple(epochs for epochs in found if len(epochs.t_s))


def _end_s(epochs: TagEpochs, begin_s: float, first: object) -> float:
    """Time until which a tag is used."""
    if not isinstance(first, First):
        return inf
    if first.seconds is not None:
        return begin_s + first.seconds
    last_s = float(epochs.t_s[-1])
    if first.part is not None:
        return begin_s + first.part * (last_s - begin_s)
    sums = np.cumsum(np.bincount(epochs.epoch, epochs.count, len(epochs.t_s)))
    return float(epochs.t_s[min(int(np.searchsorted(sums, first.count or 0)), len(sums) - 1)])


def walk_of(
    recording: McapRecording, site: int, tag: str, span: tuple[float, float] = (0.0, inf), height_m: float | None = None
) -> TagEpochs:
    """Differences of a tag that was carried around; ``span``: begin and end, in seconds since its first reception.

    ``height_m``: of the tag above the floor, if known within some 0.1 m; free otherwise.

    Raises SkylessError: the recording has no receptions of the tag, or none in the span that give a difference.
    """
    names = recording.summary().raw_tags
    if tag not in names:
        wanted = f"one of {', '.join(names)}" if names else "of a tag whose receptions were recorded"
        raise ConfigurationError(recording.summary().path, "tag", tag, wanted)
    collector = EpochCollector()
    differences, counted = RelayedDifferences(site), ""
    begin_s: float | None = None
    for segment, reception, unix_s in timed_receptions(recording, tag):
        if segment != counted:
            differences, counted = RelayedDifferences(site), segment
        begin_s = unix_s if begin_s is None else begin_s
        if span[0] <= unix_s - begin_s <= span[1]:
            for one in differences.add(reception):
                collector.add(unix_s - one.age_s, one.first, one.second, one.difference_m)
    epochs = replace(collector.epochs(), name=f"the walk of {tag}")
    if not len(epochs.t_s):
        raise SkylessError(f"the receptions of {tag} give no differences between anchors in {span[0]:g}:{span[1]:g} s")
    if height_m is None:
        return epochs
    known_m = epochs.known_m.copy()
    known_m[:, 2] = height_m
    return replace(epochs, known_m=known_m, known_std_m=(*epochs.known_std_m[:2], _HEIGHT_STD_M))


def at_positions(epochs: TagEpochs, tag: str, position_at: PositionAt) -> TagEpochs:
    """The epochs with their known positions. Epochs without one are left out."""
    known = [position_at(t_s) for t_s in epochs.t_s.tolist()]
    is_known = np.array([one is not None for one in known], dtype=bool)
    rows = is_known[epochs.epoch]
    number = np.cumsum(is_known) - 1
    of_rows = ("first", "second", "difference_m", "since_s", "count")
    return replace(
        epochs,
        **{name: getattr(epochs, name)[rows] for name in of_rows},
        t_s=epochs.t_s[is_known],
        epoch=number[epochs.epoch[rows]],
        known_m=np.array([one for one in known if one is not None]).reshape(-1, 3),
        known_std_m=(_TAG_STD_M, _TAG_STD_M, _TAG_STD_M),
        offset_std_m=_OFFSET_STD_M,
        name=f"{tag} at known positions",
    )


def timed_receptions(recording: McapRecording, tag: str) -> Iterator[tuple[str, Reception, float]]:
    """Receptions of one tag, each once, with the segment of the recording whose counter they have, and Unix time."""
    clock: HostClock[Reception] = HostClock()
    segment, following = "", 0
    for found in recording.messages({"receptions"}):
        if found.channel.name != tag:
            continue
        message = cast("ReceptionsMessage", found.message)
        if message.segment != segment:
            segment, following, clock = message.segment, message.first, HostClock()
        new = message.receptions[max(following - message.first, 0) :]
        following = max(following, message.first + len(message.receptions))
        for reception in map(reception_of, new):
            if reception is not None:
                for timed in clock.add(reception, message.unix_less_host_s, reception):
                    yield segment, *timed


_MANY_OUTLIERS: Final = 0.05
_UNEXPLAINED_SHARE: Final = 0.5

_MAX_ROWS: Final = 300_000
"""Most rows kept; of a longer recording an even sample is used."""

_NEAREST_M: Final = 0.01


class Biases(Struct, frozen=True):
    """Biases of another system's anchors, estimated from a tag at known positions."""

    format: str
    estimate: CalibrationEstimate
    anchors_m: dict[int, Point]
    """Latest positions of the anchors."""
    drops: dict[str, int]
    """Unusable differences, by reason."""
    addresses: bool = False
    """Whether identifiers are MAC addresses."""

    def name_of(self, anchor: int) -> str:
        """The name of an anchor for people."""
        return anchor_name(anchor, addresses=self.addresses)

    @property
    def notes(self) -> list[str]:
        """Sentences for the user about doubtful results."""
        found = self.estimate
        notes = [
            f"anchor {self.name_of(one.anchor)} is not determined: {one.reason}" for one in found.anchors if one.reason
        ]
        if found.rejected > _MANY_OUTLIERS * (found.used + found.rejected):
            part = found.rejected / (found.used + found.rejected)
            notes.append(f"{part:.0%} of the differences are outliers: calibrate where every anchor is in sight")
        if (found.loop_m or 0.0) > _UNEXPLAINED_SHARE * (found.noise_m or 0.0):
            notes.append(
                f"pairs of anchors remain {found.loop_m:.3f} m off, which no constants explain: something may stand "
                "between anchors or in the tag's way"
            )
        return notes


def biases_of(asked: CalibrateOptions) -> Biases:
    """Estimate constants of another system's anchors, relative to their mean.

    Raises SkylessError: the recording cannot be used, or has no differences at a known position.
    """
    asked.leave_out("tag", "recorded_truth", why="it is for recordings of skyless record")
    path = Path(asked.file)
    truth = None if asked.stays else known_truth(path, asked)
    above_m, (anchors_m, height_m) = flight_height(asked.above_m, truth), known_anchors(asked.anchors, asked.site)
    kind = format_of(path, asked.format)
    with open_recording(path, kind.name, asked.listener, anchors_m or None) as recording:
        anchors_m = anchors_m or stated_anchors(path, kind)
        position_from = partial(positions_of, asked, truth, above_m, height_m)
        differences, drops = gather(tdoas_of(recording, anchors_m), anchors_m, position_from, asked.first)
        name = recording.format.name
    if not len(differences.t_s):
        reasons = ", ".join(f"{count} × {reason}" for reason, count in drops.items())
        raise SkylessError(
            f"no time difference could be used ({reasons or 'the recording gives none'}); --truth or --at should say "
            "where the tag was, and --anchors or --site where the anchors are"
        )
    return Biases(name, estimate(differences), anchors_m, drops, kind.is_dl_tdoa)


def tdoas_of(recording: Recording, anchors_m: Mapping[int, Point]) -> Iterator[PairTdoa]:
    """Time differences of a recording in any format."""
    bits = recording.format.tx_bits
    engine = None if bits is None else PairEngine(bits, anchors_m=dict(anchors_m))
    for record in recording:
        if isinstance(record, Packet):
            assert engine is not None
            yield from engine.on_packet(record)
        else:
            yield record


def gather(
    pairs: Iterable[PairTdoa],
    anchors_m: dict[int, Point],
    position_from: Callable[[float], PositionAt],
    asked_first: object,
) -> tuple[Differences, dict[str, int]]:
    """Gather the differences at known positions, and count those that cannot be used by reason.

    ``anchors_m`` is brought up to date. ``position_from`` is called with the time of the first difference.
    """
    drops: Drops = Counter()
    first = asked_first if isinstance(asked_first, First) else First()
    sample = EvenSample(5, _MAX_ROWS)
    position_at: PositionAt | None = None
    begin_s = last_s = 0.0
    for pair in pairs:
        if position_at is None:
            position_at, begin_s = position_from(pair.time_s), pair.time_s
        if first.seconds is not None and pair.time_s - begin_s > first.seconds:
            break
        last_s = max(last_s, pair.time_s)
        row = _row(pair, anchors_m, position_at)
        if isinstance(row, str):
            drops[row] += 1
            continue
        sample.add(row)
        if sample.seen == first.count:
            break
    rows = sample.rows
    if first.part is not None:
        rows = rows[rows[:, 0] <= begin_s + first.part * (last_s - begin_s)]
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    ids = rows[:, 1:3].astype(np.int64)
    return Differences(rows[:, 0], ids[:, 0], ids[:, 1], rows[:, 3], rows[:, 4]), dict(sorted(drops.items()))


def _row(pair: PairTdoa, anchors_m: dict[int, Point], position_at: PositionAt) -> tuple[float, ...] | str:
    """Time, anchors, excess over the geometry, and log of the ranges' ratio; or the reason for a drop."""
    if pair.a_m is not None:
        anchors_m[pair.anchor_a] = pair.a_m
    if pair.b_m is not None:
        anchors_m[pair.anchor_b] = pair.b_m
    a_m, b_m = anchors_m.get(pair.anchor_a), anchors_m.get(pair.anchor_b)
    if a_m is None or b_m is None:
        return "unknown-anchor"
    at_m = position_at(pair.time_s)
    if at_m is None:
        return "place-unknown"
    range_a, range_b = max(dist(at_m, a_m), _NEAREST_M), max(dist(at_m, b_m), _NEAREST_M)
    excess_m = pair.tdoa_m - (range_b - range_a)
    return pair.time_s, float(pair.anchor_a), float(pair.anchor_b), excess_m, log(range_b / range_a)


# Ranges of pairs of anchors from a recording of a site, or of another system whose anchors range.

_REPORT_EVERY: Final = 1000
"""Records between two reports of progress."""

_MAX_SEEN: Final = 1 << 16
"""Added legs that are remembered, as several listeners relay the same ones."""


class Gathered(Struct, frozen=True):
    """Input of a survey."""

    ranger: PairRanger | PairRanges
    """Gives the ranges as measured; a ranger can also drop those from before an anchor was moved."""
    site: Site | None = None
    """The site of --site, else of the recording."""
    drops: dict[str, int] = {}
    """Unusable parts of a recording, by reason."""
    is_foreign: bool = False
    """Whether the recording is of another system."""
    delays_m: Mapping[int, float] = {}
    """By how much half an anchor's delays are larger at the site than they were while ranges were measured."""

    @property
    def ranges(self) -> PairRanges:
        """The ranges with the antenna delays of the site, and its anchors without ranges, too."""
        found = self.ranger if isinstance(self.ranger, PairRanges) else self.ranger.ranges()
        of_site = () if self.site is None else [anchor.id for anchor in self.site.all_anchors]
        return replace(found.without_delays(self.delays_m), anchors=tuple(sorted({*found.anchors, *of_site})))


def ranges_of(
    path: str | PathLike[str],
    format_name: str | None = None,
    *,
    identifier: int | None = None,
    on_progress: Callable[[float], None] | None = None,
    new_ranger: Callable[[int], PairRanger] = PairRanger,
) -> Gathered:
    """Ranges from a recording of ``skyless record``, or of another system; ``format_name`` chooses the format.

    ``identifier``: of the site, if it should be checked. ``on_progress`` is called now and then with the share of the
    recording that has been read, ``new_ranger`` with the width of the counters.

    Raises ConfigurationError: the file cannot be read, or its format has no stamps of anchors.
    """
    if format_name == SITE_FORMAT or (format_name is None and is_mcap(path)):
        return _of_site(path, identifier, _Legs(new_ranger(TICK_BITS), on_progress))
    known = format_of(path, format_name)
    if known.tx_bits is None:
        stamped = ", ".join(one.name for one in FORMATS if one.tx_bits is not None and not one.is_dl_tdoa)
        raise ConfigurationError(path, "format", known.name, f"one with stamps of anchors: {SITE_FORMAT}, {stamped}")
    if known.is_dl_tdoa:
        right = "of a system whose anchors all range each other; here positions are those that messages state"
        raise ConfigurationError(path, "format", known.name, f"{right}, or those of --anchors")
    legs = _Legs(new_ranger(known.tx_bits), on_progress)
    drops = _add_receptions(path, legs) if known.name == "avalue" else _add_packets(path, known.name, legs)
    return Gathered(legs.ranger, None, dict(drops + legs.finish()), is_foreign=True)


class _Legs:
    """Collects the legs of a recording, each once."""

    def __init__(self, ranger: PairRanger, on_progress: Callable[[float], None] | None) -> None:
        self.ranger = ranger
        self._on_progress, self._records = on_progress, 0
        self._seen: OrderedDict[tuple[int, int, int], None] = OrderedDict()

    def add(self, leg: AnchorLeg) -> None:
        """Add a leg if it is new."""
        key = (leg.sender, leg.receiver, leg.rx_ticks)
        if key in self._seen:
            return
        self._seen[key] = None
        if len(self._seen) > _MAX_SEEN:
            self._seen.popitem(last=False)
        self.ranger.add(leg.sender, leg.receiver, leg.tx_ticks, leg.rx_ticks, leg.t_s)

    def report(self, share: Callable[[], float]) -> None:
        """Count a record, and report progress now and then."""
        self._records += 1
        if self._on_progress is not None and self._records % _REPORT_EVERY == 0:
            self._on_progress(min(max(share(), 0.0), 1.0))

    def finish(self) -> Counter[str]:
        """Finish, and return what the ranger could not use, by reason."""
        self.ranger.finish()
        return _drops(self.ranger.counters)


def _drops(counters: Counter[str]) -> Counter[str]:
    return Counter({name: count for name, count in counters.items() if name != "legs" and count})


def _of_site(path: str | PathLike[str], identifier: int | None, legs: _Legs) -> Gathered:
    """Ranges from tags' receptions, and from anchors' own stamps if recorded."""
    drops: Counter[str] = Counter()
    collectors: dict[str, LegCollector] = {}
    runs: dict[int, str] = {}
    with McapRecording(path) as recording:
        site = recorded_site(recording, identifier)
        known = {anchor.id for anchor in site.anchors}
        summary = recording.summary()
        begin_s, end_s = summary.start_s or 0.0, summary.end_s or 1.0
        for found in recording.messages({"receptions", "stamps"}):
            time_s = found.time_s
            legs.report(lambda: (time_s - begin_s) / max(end_s - begin_s, 1.0))  # noqa: B023 - called at once
            if found.channel.site != str(site.id):
                drops["foreign-site"] += 1
                continue
            if isinstance(found.message, StampsMessage):
                found_legs = _of_anchor(found.message, legs.ranger, runs)
            else:
                collector = collectors.setdefault(found.channel.name, LegCollector(site.id))
                found_legs = _of_tag(found, collector)
            for leg in found_legs:
                if {leg.sender, leg.receiver} <= known:
                    legs.add(leg)
                else:
                    drops["unknown-anchor"] += 1
        summary = recording.summary()
    damage = Counter(summary.drops)
    if summary.unread_bytes:
        damage["unfinished-record"] += 1
    for collector in collectors.values():
        drops += _drops(collector.counters)
    return Gathered(legs.ranger, site, dict(damage + drops + legs.finish()))


def _of_anchor(message: StampsMessage, ranger: PairRanger, runs: dict[int, str]) -> list[AnchorLeg]:
    """Legs that an anchor received, with the message's time."""
    if runs.setdefault(message.anchor, message.run) != message.run:
        runs[message.anchor] = message.run
        ranger.forget(message.anchor)
    return [
        AnchorLeg(stamp.anchor, message.anchor, stamp.tx_ticks, stamp.rx_ticks, message.unix_s)
        for stamp in message.stamps
    ]


def _of_tag(found: Recorded, collector: LegCollector) -> list[AnchorLeg]:
    """Legs that a tag learned from beacons, in Unix time."""
    message = cast("ReceptionsMessage", found.message)
    legs: list[AnchorLeg] = []
    for raw in message.receptions:
        host_s = None if raw.host_s is None else raw.host_s + message.unix_less_host_s
        legs += collector.add(Reception(raw.frame, raw.rx_ticks, found.time_s if host_s is None else host_s))
    return legs


def _add_packets(path: str | PathLike[str], format_name: str, legs: _Legs) -> Counter[str]:
    """Add legs learned by a listener to another system's packets, with times by its own counter.

    Antenna delays included in the stamps are subtracted, so that ranges are near the distances.
    """
    with open_recording(path, format_name) as recording:
        matcher, ticks = RelayMatcher(recording.format.tx_bits or TICK_BITS), Unwrapper()
        size = Path(path).stat().st_size
        for packet in recording:
            legs.report(lambda: recording.bytes_read / max(size, 1))
            if not isinstance(packet, Packet):
                continue
            now_ticks = ticks.unwrap(packet.rx_ticks, packet.host_s)
            t_s = to_seconds(now_ticks)
            for leg in matcher.add(packet.anchor, packet.sequence, packet.tx_ticks, packet.relays, now_ticks, t_s):
                legs.add(replace(leg, rx_ticks=leg.rx_ticks - recording.format.delays_ticks))
        return recording.drops + _drops(matcher.counters)


def _add_receptions(path: str | PathLike[str], legs: _Legs) -> Counter[str]:
    """Add legs between Avalue's anchors."""
    drops: Drops = Counter()
    with open_source(path) as stream:
        size = Path(path).stat().st_size
        for heard in datasets.cross_receptions(stream, drops):
            legs.report(lambda: os.lseek(stream.fileno(), 0, os.SEEK_CUR) / max(size, 1))
            legs.add(AnchorLeg(heard.sender, heard.receiver, heard.tx_ticks, heard.rx_ticks, heard.host_s))
    return drops
