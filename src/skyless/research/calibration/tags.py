"""Tags of a recording of ``skyless record`` that were carried around, or stood at known positions."""

from collections.abc import Callable, Iterator, Sequence
from math import inf
from typing import Final, cast

import numpy as np
from msgspec.structs import replace

from skyless.core.air.frame import Reception
from skyless.core.air.masterless_packets import Point
from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.site import Site
from skyless.research.calibration.options import First, Stay, SurveyOptions
from skyless.research.replays.site import reception_of, recorded_truth
from skyless.run.mqtt.messages import ReceptionsMessage
from skyless.run.recordings.recording import HostClock, McapRecording, tags_to_replay
from skyless.sim.evaluation.figures import TruthTrack
from skyless.site.survey.legs import RelayedDifferences
from skyless.site.survey.walk import EPOCH_S, EpochCollector, TagEpochs
from skyless.site.tables import Truth

_TAG_STD_M: Final = 0.02
"""Standard deviation of a tag's known position, per axis."""

_OFFSET_STD_M: Final = 0.03
"""Each anchor's own constant at the tag, which is no delay: reflections that are always there. It is less than in a
walk, as delays are what is looked for."""

_HEIGHT_STD_M: Final = 0.1
"""How well the height of a tag that is carried around is known."""

PositionAt = Callable[[float], Point | None]
"""Where the tag's antenna was at a time of the recording; None where that is not known."""


def position_of_truth(truth: TruthTrack, above_m: float | None) -> PositionAt:
    """Truth by time, where it is high enough."""

    def position_at(time_s: float) -> Point | None:
        at_m = truth.at(time_s)
        return None if at_m is None or (above_m is not None and at_m[2] <= above_m) else at_m

    return position_at


def position_of_stays(stays: Sequence[Stay], height_m: float | None, begin_s: float) -> PositionAt:
    """Known positions by time; of stays that overlap the first counts.

    Raises:
        SkylessError: a stay has no height, and the site does not know it either.
    """
    stays_m: list[tuple[Stay, Point]] = []
    for stay in stays:
        z_m = height_m if stay.z_m is None else stay.z_m
        if z_m is None:
            raise SkylessError(f"--at {stay.x_m:g},{stay.y_m:g} lacks its height: it should be x,y,z")
        stays_m.append((stay, (stay.x_m, stay.y_m, z_m)))

    def position_at(time_s: float) -> Point | None:
        since_s = time_s - begin_s
        return next((position_m for stay, position_m in stays_m if stay.from_s <= since_s <= stay.to_s), None)

    return position_at


def walks_of(recording: McapRecording, site: int, asked: SurveyOptions) -> tuple[TagEpochs, ...]:
    """What the tags of --walk received while they were carried around. Raises SkylessError."""
    return tuple(
        replace(
            walk_of(recording, site, walk.tag, (walk.from_s, walk.to_s), asked.walk_height_m),
            name=f"the walk of {walk.tag}",
        )
        for walk in asked.walks
        if not isinstance(walk, str)
    )


def known_tags(
    recording: McapRecording, site: Site, asked: SurveyOptions, truth: Truth | None
) -> tuple[TagEpochs, ...]:
    """What tags received while it was known where they were.

    ``truth``: that of a table, in Unix time. Raises SkylessError.
    """
    raw = tags_to_replay(recording.summary())
    names, recorded = ", ".join(raw), recorded_truth(recording)
    if asked.tag is not None and asked.tag not in raw:
        raise ConfigurationError(asked.recording or "", "tag", asked.tag, f"one of {names}")
    if asked.tag is None and len(raw) > 1 and not asked.recorded_truth:
        raise SkylessError(f"--tag is missing; it should name the tag whose position is known, one of {names}")
    found = []
    for tag in raw if asked.tag is None else (asked.tag,):
        epochs = walk_of(recording, site.id, tag)
        begin_s = float(epochs.t_s[0]) - EPOCH_S / 2.0
        if asked.stays:
            known = position_of_stays(
                [one for one in asked.stays if isinstance(one, Stay)], site.tags.height_m, begin_s
            )
        else:
            known = position_of_truth(TruthTrack(truth or recorded.get(tag)), asked.above_m)
        end_s = _end_s(epochs, begin_s, asked.first)
        found.append(at_positions(epochs, tag, lambda t_s: known(t_s) if t_s <= end_s else None))  # noqa: B023 - at once
    if not any(len(epochs.t_s) for epochs in found):
        raise SkylessError(
            "the tag was nowhere at a known position; --at, --truth or --recorded-truth should say where it was"
        )
    return tuple(epochs for epochs in found if len(epochs.t_s))


def _end_s(epochs: TagEpochs, begin_s: float, first: object) -> float:
    """Until when a tag is used."""
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
    """Differences of a tag that was carried around; ``span``: from and to, in seconds since its first reception.

    ``height_m``: of the tag above the floor, if it is known within some 0.1 m; free otherwise.

    Raises:
        SkylessError: the recording has no receptions of the tag, or none in the span that give a difference.
    """
    names = recording.summary().raw_tags
    if tag not in names:
        wanted = f"one of {', '.join(names)}" if names else "of a tag whose receptions were recorded"
        raise ConfigurationError(recording.summary().path, "tag", tag, wanted)
    collector = EpochCollector()
    receptions, differences = NewReceptions(), RelayedDifferences(site)
    begin_s: float | None = None
    for found in recording.messages({"receptions"}):
        if found.channel.name != tag:
            continue
        message = cast("ReceptionsMessage", found.message)
        if receptions.begins(message):
            differences = RelayedDifferences(site)
        for reception, unix_s in receptions.read(message):
            begin_s = unix_s if begin_s is None else begin_s
            if span[0] <= unix_s - begin_s <= span[1]:
                for one in differences.add(reception):
                    collector.add(unix_s - one.age_s, one.first, one.second, one.difference_m)
    epochs = collector.epochs()
    if not len(epochs.t_s):
        raise SkylessError(f"the receptions of {tag} give no differences between anchors in {span[0]:g}:{span[1]:g} s")
    if height_m is None:
        return epochs
    known_m = epochs.known_m.copy()
    known_m[:, 2] = height_m
    return replace(epochs, known_m=known_m, known_std_m=(*epochs.known_std_m[:2], _HEIGHT_STD_M))


def at_positions(epochs: TagEpochs, tag: str, position_at: PositionAt) -> TagEpochs:
    """The epochs with known positions. Epochs without one are left out."""
    known = [position_at(t_s) for t_s in epochs.t_s.tolist()]
    is_known = np.array([one is not None for one in known], dtype=bool)
    rows = is_known[epochs.epoch]
    number = np.cumsum(is_known) - 1
    return replace(
        epochs,
        t_s=epochs.t_s[is_known],
        epoch=number[epochs.epoch[rows]],
        first=epochs.first[rows],
        second=epochs.second[rows],
        difference_m=epochs.difference_m[rows],
        since_s=epochs.since_s[rows],
        count=epochs.count[rows],
        known_m=np.array([one for one in known if one is not None]).reshape(-1, 3),
        known_std_m=(_TAG_STD_M, _TAG_STD_M, _TAG_STD_M),
        offset_std_m=_OFFSET_STD_M,
        name=f"{tag} at known positions",
    )


class NewReceptions:
    """One tag's receptions, as they come, each once."""

    def __init__(self) -> None:
        self._clock: HostClock[Reception] = HostClock()
        self._segment = ""
        self._next = 0

    def begins(self, message: ReceptionsMessage) -> bool:
        """Whether the tag has started again; receptions before are of another counter."""
        if message.segment == self._segment:
            return False
        self._segment, self._next, self._clock = message.segment, message.first, HostClock()
        return True

    def read(self, message: ReceptionsMessage) -> Iterator[tuple[Reception, float]]:
        """Receptions, each once, with Unix time: of this run and of runs before, as their times become known."""
        new = message.receptions[max(self._next - message.first, 0) :]
        self._next = max(self._next, message.first + len(message.receptions))
        for raw in new:
            reception = reception_of(raw)
            if reception is not None:
                yield from self._clock.add(reception, message.unix_less_host_s, reception)
