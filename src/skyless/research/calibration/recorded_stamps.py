"""Ranges of pairs of anchors out of a recording: of a running site, or of another system whose anchors range."""

import math
import os
from collections import Counter, OrderedDict
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Final, cast

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air.frame import Reception
from skyless.core.air.masterless_packets import Packet
from skyless.core.errors import ConfigurationError
from skyless.core.input_files import Drops, open_source
from skyless.core.site import Site
from skyless.core.ticks import TICK_BITS, Unwrapper, to_seconds
from skyless.research.foreign import avalue
from skyless.research.foreign.formats import FORMATS, format_of, open_recording
from skyless.research.replays.site import SITE_FORMAT, recorded_site
from skyless.run.mqtt.messages import ReceptionsMessage, StampsMessage
from skyless.run.recordings.recording import McapRecording, Recorded, is_mcap
from skyless.site.survey.facts import PairBlock, PairRanges
from skyless.site.survey.legs import AnchorLeg, LegCollector, RelayMatcher
from skyless.site.survey.pair_ranger import PairRanger

_REPORT_EVERY: Final = 1000
"""Records between two reports of progress."""

_MAX_SEEN: Final = 1 << 16
"""Legs that are known to have been added: several listeners relay the same ones."""


class RecordedRanges(Struct, frozen=True):
    """Ranges out of a recording, and what could not be used."""

    ranges: PairRanges
    ranger: PairRanger
    """What made the ranges, and can drop those from before an anchor was moved."""
    format: str
    site: Site | None
    """The recorded site. None for recordings of other systems."""
    drops: dict[str, int]
    """What could not be used, by reason."""
    damage: dict[str, int] = {}
    """Those of the drops that are damage of the file, which other readers of it meet as well."""


def ranges_of(
    path: str | PathLike[str],
    format_name: str | None = None,
    *,
    identifier: int | None = None,
    block_s: float = 1.0,
    on_block: Callable[[PairBlock], None] | None = None,
    from_s: float = 0.0,
    to_s: float = math.inf,
    on_progress: Callable[[float], None] | None = None,
) -> RecordedRanges:
    """Ranges of a recording of ``skyless record``, or of another system's; ``format_name`` chooses its format.

    ``identifier``: of the site, where it should be checked. ``block_s``, ``on_block``: of ``PairRanger``. ``from_s``,
    ``to_s``: the part in use, in seconds since the first leg. ``on_progress`` is given the share of the recording that
    has been read, now and then.

    Raises:
        ConfigurationError: the file cannot be read, or its format has no stamps of anchors.
    """
    if format_name == SITE_FORMAT or (format_name is None and is_mcap(path)):
        part = _Part(PairRanger(TICK_BITS, block_s, on_block=on_block), from_s, to_s, on_progress)
        return _of_site(path, identifier, part)
    known = format_of(path, format_name)
    if known.tx_bits is None:
        stamped = ", ".join(one.name for one in FORMATS if one.tx_bits is not None)
        raise ConfigurationError(path, "format", known.name, f"one with stamps of anchors: {SITE_FORMAT}, {stamped}")
    part = _Part(PairRanger(known.tx_bits, block_s, on_block=on_block), from_s, to_s, on_progress)
    drops = _add_receptions(path, part) if known.name == "avalue" else _add_packets(path, known.name, part)
    return RecordedRanges(part.finish(), part.ranger, known.name, None, dict(drops + part.drops()))


class _Part:
    """The legs of a part of a recording, each once."""

    def __init__(
        self, ranger: PairRanger, from_s: float, to_s: float, on_progress: Callable[[float], None] | None
    ) -> None:
        self.ranger = ranger
        self._from_s, self._to_s = from_s, to_s
        self._on_progress, self._records = on_progress, 0
        self._begin_s: float | None = None
        self._seen: OrderedDict[tuple[int, int, int], None] = OrderedDict()

    def add(self, leg: AnchorLeg) -> None:
        """Add a leg that lies in the part."""
        key = (leg.sender, leg.receiver, leg.rx_ticks)
        if key in self._seen:
            return
        self._seen[key] = None
        if len(self._seen) > _MAX_SEEN:
            self._seen.popitem(last=False)
        if self._begin_s is None:
            self._begin_s = leg.t_s
        if self._from_s <= leg.t_s - self._begin_s < self._to_s:
            self.ranger.add(leg.sender, leg.receiver, leg.tx_ticks, leg.rx_ticks, leg.t_s)

    def report(self, share: Callable[[], float]) -> None:
        """Count a record, and report progress now and then."""
        self._records += 1
        if self._on_progress is not None and self._records % _REPORT_EVERY == 0:
            self._on_progress(min(max(share(), 0.0), 1.0))

    def finish(self) -> PairRanges:
        """The ranges of all legs."""
        self.ranger.finish()
        return self.ranger.ranges()

    def drops(self) -> Counter[str]:
        """What the ranger could not use."""
        return _drops(self.ranger.counters)


def _drops(counters: Counter[str]) -> Counter[str]:
    return Counter({name: count for name, count in counters.items() if name != "legs" and count})


def _of_site(path: str | PathLike[str], identifier: int | None, part: _Part) -> RecordedRanges:
    """From what tags received, and from anchors' own stamps where they were recorded."""
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
            part.report(lambda: (time_s - begin_s) / max(end_s - begin_s, 1.0))  # noqa: B023 - called at once
            if found.channel.site != str(site.id):
                drops["foreign-site"] += 1
                continue
            if isinstance(found.message, StampsMessage):
                legs = _of_anchor(found.message, part.ranger, runs)
            else:
                collector = collectors.setdefault(found.channel.name, LegCollector(site.id))
                legs = _of_tag(found, collector)
            for leg in legs:
                if {leg.sender, leg.receiver} <= known:
                    part.add(leg)
                else:
                    drops["unknown-anchor"] += 1
        damage = _damage(recording)
    for collector in collectors.values():
        drops += _drops(collector.counters)
    return RecordedRanges(
        part.finish(), part.ranger, SITE_FORMAT, site, dict(damage + drops + part.drops()), dict(damage)
    )


def _damage(recording: McapRecording) -> Counter[str]:
    """What could not be read of the file, after it was read."""
    summary = recording.summary()
    damage = Counter(summary.drops)
    if summary.unread_bytes:
        damage["unfinished-record"] += 1
    return damage


def _of_anchor(message: StampsMessage, ranger: PairRanger, runs: dict[int, str]) -> list[AnchorLeg]:
    """What an anchor received; its time is that of the message."""
    if runs.setdefault(message.anchor, message.run) != message.run:
        runs[message.anchor] = message.run
        ranger.forget(message.anchor)
    return [
        AnchorLeg(stamp.anchor, message.anchor, stamp.tx_ticks, stamp.rx_ticks, message.unix_s)
        for stamp in message.stamps
    ]


def _of_tag(found: Recorded, collector: LegCollector) -> list[AnchorLeg]:
    """What a tag learned of anchors, in Unix time."""
    message = cast("ReceptionsMessage", found.message)
    legs: list[AnchorLeg] = []
    for raw in message.receptions:
        host_s = None if raw.host_s is None else raw.host_s + message.unix_less_host_s
        legs += collector.add(Reception(raw.frame, raw.rx_ticks, found.time_s if host_s is None else host_s))
    return legs


def _add_packets(path: str | PathLike[str], format_name: str, part: _Part) -> Counter[str]:
    """Add what a listener of another system's packets learned; its own counter gives the times.

    Antenna delays that the stamps include are subtracted, so that ranges are near the distances.
    """
    with open_recording(path, format_name) as recording:
        matcher, ticks = RelayMatcher(recording.format.tx_bits or TICK_BITS), Unwrapper()
        size = Path(path).stat().st_size
        for packet in recording:
            part.report(lambda: recording.bytes_read / max(size, 1))
            if not isinstance(packet, Packet):
                continue
            now_ticks = ticks.unwrap(packet.rx_ticks, packet.host_s)
            t_s = to_seconds(now_ticks)
            for leg in matcher.add(packet.anchor, packet.sequence, packet.tx_ticks, packet.relays, now_ticks, t_s):
                part.add(replace(leg, rx_ticks=leg.rx_ticks - recording.format.delays_ticks))
        return recording.drops + _drops(matcher.counters)


def _add_receptions(path: str | PathLike[str], part: _Part) -> Counter[str]:
    """Add what Avalue's anchors received of one another."""
    drops: Drops = Counter()
    with open_source(path) as stream:
        size = Path(path).stat().st_size
        for heard in avalue.cross_receptions(stream, drops):
            part.report(lambda: os.lseek(stream.fileno(), 0, os.SEEK_CUR) / max(size, 1))
            part.add(AnchorLeg(heard.sender, heard.receiver, heard.tx_ticks, heard.rx_ticks, heard.host_s))
    return drops
