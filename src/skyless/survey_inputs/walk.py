"""A tag that was carried around, or stood at known positions, out of a recording of ``skyless record``."""

from collections.abc import Iterator, Mapping
from math import inf
from typing import cast

import numpy as np
from msgspec.structs import replace

from skyless.air.masterless_packets import PairTdoa
from skyless.errors import ConfigurationError, SkylessError
from skyless.mqtt.messages import ReceptionsMessage
from skyless.recordings.mcap.recording import McapRecording
from skyless.survey.tags.epochs import EpochCollector, TagEpochs
from skyless.survey.tags.relayed import RelayedDifference, RelayedDifferences
from skyless.survey_inputs.samples import NewReceptions, PositionAt


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
        raise ConfigurationError("--walk", "tag", tag, wanted)
    collector = EpochCollector(relayed=True)
    for t_s, one in _differences(recording, site, tag, span):
        collector.add(t_s, one.first, one.second, one.difference_m)
    epochs = collector.epochs()
    if not len(epochs.t_s):
        raise SkylessError(f"the receptions of {tag} give no differences between anchors in {span[0]:g}:{span[1]:g} s")
    return epochs if height_m is None else at_height(epochs, height_m)


def relayed_tdoas(
    recording: McapRecording, tag: str, site: int, ranges_m: Mapping[tuple[int, int], float]
) -> Iterator[PairTdoa]:
    """A tag's time differences where there is no site time: the ranges of pairs, as measured, are taken off.

    ``ranges_m``: of anchors (a, b), a < b; of other pairs nothing is used. Times are Unix seconds.
    """
    for t_s, one in _differences(recording, site, tag, (0.0, inf)):
        range_m = ranges_m.get((min(one.first, one.second), max(one.first, one.second)))
        if range_m is not None:
            yield PairTdoa(t_s, one.first, one.second, one.difference_m - range_m)


def _differences(
    recording: McapRecording, site: int, tag: str, span: tuple[float, float]
) -> Iterator[tuple[float, RelayedDifference]]:
    """With Unix times, within a span of seconds since the tag's first reception."""
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
                    yield unix_s - one.age_s, one


def at_height(epochs: TagEpochs, height_m: float, std_m: float = 0.1) -> TagEpochs:
    """The same with a known height of the tag."""
    known_m = epochs.known_m.copy()
    known_m[:, 2] = height_m
    return replace(epochs, known_m=known_m, known_std_m=(*epochs.known_std_m[:2], std_m))


def at_positions(epochs: TagEpochs, position_at: PositionAt, std_m: float, offset_std_m: float) -> TagEpochs:
    """The same with known positions; epochs without one are left out.

    ``offset_std_m``: of each anchor's own constant at the tag; less than in a walk, as delays are what is looked for.
    """
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
        known_std_m=(std_m, std_m, std_m),
        offset_std_m=offset_std_m,
    )
