"""By how much each anchor of another system seems late, from a tag at known positions, in bounded memory."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from math import dist, log
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from msgspec import Struct

from skyless.core.air.masterless_packets import Packet, PairTdoa, Point
from skyless.core.errors import SkylessError
from skyless.core.input_files import Drops
from skyless.research.calibration.options import First, Stay, SurveyOptions
from skyless.research.calibration.tags import PositionAt, position_of_stays, position_of_truth
from skyless.research.foreign.formats import Recording, open_recording
from skyless.research.masterless.pair_engine import PairEngine
from skyless.research.replays.inputs import flight_height, known_anchors, known_truth
from skyless.sim.evaluation.figures import EvenSample, TruthTrack
from skyless.site.survey.estimate import CalibrationEstimate, Differences, estimate
from skyless.site.tables import calibrated_table, new_table

_MANY_OUTLIERS: Final = 0.05
_UNEXPLAINED_SHARE: Final = 0.5

_MAX_ROWS: Final = 300_000
"""Rows that are kept; of a longer recording an even sample is used."""

_NEAREST_M: Final = 0.01


class Samples(Struct, frozen=True):
    """Time differences at known positions, out of a recording."""

    differences: Differences
    anchors_m: dict[int, Point]
    """Where the anchors stand, or last stood."""
    seen: int
    drops: dict[str, int]
    """Differences that could not be used, by reason."""


class Biases(Struct, frozen=True):
    """What a tag at known positions has shown of the anchors of another system."""

    format: str
    estimate: CalibrationEstimate
    samples: Samples

    @property
    def notes(self) -> list[str]:
        """What the user should know."""
        found = self.estimate
        notes = [f"anchor {one.anchor} is not determined: {one.reason}" for one in found.anchors if one.reason]
        if found.rejected > _MANY_OUTLIERS * (found.used + found.rejected):
            part = found.rejected / (found.used + found.rejected)
            notes.append(f"{part:.0%} of the differences are outliers: calibrate where every anchor is in sight")
        if (found.loop_m or 0.0) > _UNEXPLAINED_SHARE * (found.noise_m or 0.0):
            notes.append(
                f"pairs of anchors remain {found.loop_m:.3f} m off, which no constants explain: something may stand "
                "between anchors or in the tag's way"
            )
        return notes

    def report(self) -> dict[str, Any]:
        """All of it, SI units."""
        estimated = msgspec.to_builtins(self.estimate)
        return {"format": self.format, **estimated, "drops": self.samples.drops, "notes": self.notes}

    def table(self, anchors: str | Path | None) -> str:
        """The table of anchors with the biases in it; a new one where none is given. Raises SkylessError."""
        known = self.estimate.calibration()
        return new_table(self.samples.anchors_m, known) if anchors is None else calibrated_table(anchors, known)


def biases_of(asked: SurveyOptions) -> Biases:
    """Constants of the anchors of another system, whose zero is their mean.

    Raises:
        SkylessError: the recording cannot be used, or holds nothing at a known position.
    """
    asked.leave_out("tag", "recorded_truth", "walks", why="it is for recordings of skyless record")
    path, first = Path(str(asked.recording)), asked.first if isinstance(asked.first, First) else First()
    truth = None if asked.stays else known_truth(path, asked)
    above_m, (anchors_m, height_m) = flight_height(asked.above_m, truth), known_anchors(asked.anchors, asked.site)

    def position_from(begin_s: float) -> PositionAt:
        if asked.stays:
            return position_of_stays([one for one in asked.stays if isinstance(one, Stay)], height_m, begin_s)
        return position_of_truth(TruthTrack(truth), above_m)

    with open_recording(path, asked.format, asked.listener) as recording:
        samples = gather(tdoas_of(recording, anchors_m), anchors_m, position_from, first)
        name = recording.format.name
    if not len(samples.differences.t_s):
        reasons = ", ".join(f"{count} × {reason}" for reason, count in samples.drops.items())
        raise SkylessError(
            f"no time difference could be used ({reasons or 'the recording gives none'}); --truth or --at should say "
            "where the tag was, and --anchors or --site where the anchors are"
        )
    return Biases(name, estimate(samples.differences), samples)


def tdoas_of(recording: Recording, anchors_m: Mapping[int, Point]) -> Iterator[PairTdoa]:
    """All time differences of a recording in any format."""
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
    anchors_m: Mapping[int, Point],
    position_from: Callable[[float], PositionAt],
    first: First,
) -> Samples:
    """Gather the differences at known positions; ``position_from`` gets the time of the first difference."""
    drops: Drops = Counter()
    anchor_positions_m = dict(anchors_m)
    sample = EvenSample(5, _MAX_ROWS)
    position_at: PositionAt | None = None
    begin_s = last_s = 0.0
    for pair in pairs:
        if position_at is None:
            position_at, begin_s = position_from(pair.time_s), pair.time_s
        if first.seconds is not None and pair.time_s - begin_s > first.seconds:
            break
        last_s = max(last_s, pair.time_s)
        row = _row(pair, anchor_positions_m, position_at)
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
    differences = Differences(rows[:, 0], ids[:, 0], ids[:, 1], rows[:, 3], rows[:, 4])
    return Samples(differences, anchor_positions_m, sample.seen, dict(sorted(drops.items())))


def _row(pair: PairTdoa, anchor_positions_m: dict[int, Point], position_at: PositionAt) -> tuple[float, ...] | str:
    """Time, anchors, excess over the geometry, logarithm of the ranges' ratio; or why there is none."""
    if pair.a_m is not None:
        anchor_positions_m[pair.anchor_a] = pair.a_m
    if pair.b_m is not None:
        anchor_positions_m[pair.anchor_b] = pair.b_m
    a_m, b_m = anchor_positions_m.get(pair.anchor_a), anchor_positions_m.get(pair.anchor_b)
    if a_m is None or b_m is None:
        return "unknown-anchor"
    at_m = position_at(pair.time_s)
    if at_m is None:
        return "place-unknown"
    range_a, range_b = max(dist(at_m, a_m), _NEAREST_M), max(dist(at_m, b_m), _NEAREST_M)
    excess_m = pair.tdoa_m - (range_b - range_a)
    return pair.time_s, float(pair.anchor_a), float(pair.anchor_b), excess_m, log(range_b / range_a)
