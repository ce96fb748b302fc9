"""A large site as a tape of beacons: what a tag hears in a span of time, computed when it is asked for.

There are no anchor machines here. Anchors send at their published instants (``core/air/almanac``) on crystals of their
own, and a beacon relays the newest receptions of its sender. Random numbers are functions of keys, so what a tag hears
does not depend on other tags, and a reception that two beacons relay has the same stamp in both.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any, Final, cast

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.core.air.almanac import Page, gap_ticks, period_code, suitable_period_s
from skyless.core.air.beacon import Beacon
from skyless.core.air.frame import Malformed, PackedHeard, Reception, after_rmarker_s, preamble_s
from skyless.core.air.site_pages import decode_page, encode_page, site_issue
from skyless.core.arrays import Array, Integers
from skyless.core.geometry import anchor_positions, anchors_in_reach
from skyless.core.pages import site_page_for, site_pages_of, stated_position
from skyless.core.site import Site
from skyless.core.ticks import (
    DELAYED_TX_GRANULARITY_TICKS,
    TICK_M,
    TICK_MASK,
    TICK_RATE_HZ,
    TICK_S,
    WRAP_TICKS,
    from_seconds,
)
from skyless.sim.impairments import SLOPE_MIDDLE_M, Impairments, RangeErrorModel
from skyless.sim.oscillator import OscillatorModel
from skyless.sim.trajectory import Trajectory
from skyless.site.channel import FREE_SPACE_LOSS_1_M_DB

MAX_RELAYS: Final = 6
"""In a beacon: more than six hardly make fixes better."""

_FRAME_BYTES: Final = 123
"""Length of every frame: a beacon with six relays and a page."""
_LEAD_TICKS: Final = from_seconds(1e-3)
"""Time before the RMARKER at which a beacon's relays are fixed, as in ``World``."""
_PREAMBLE_TICKS: Final = from_seconds(preamble_s())
_AFTER_TICKS: Final = from_seconds(after_rmarker_s(_FRAME_BYTES))
_AIR_TICKS: Final = _PREAMBLE_TICKS + _AFTER_TICKS

_RELAY_AGE_TICKS: Final = round(TICK_RATE_HZ)
"""Older receptions are not relayed, as in ``skyless.core.anchor``."""
_CANDIDATES: Final = 96
"""Newest frames of a sender's neighbours among which its relays are looked for at first."""

_AUDIBLE_WIDTHS: Final = 12.0
"""Widths of the loss's logistic function below the sensitivity, from which on nothing is received."""

_KNOT_TICKS: Final = 1 << 31
"""True time between knots of the clocks, 34 ms; straight lines between them are off by 2 ps."""
_KNOT_S: Final = _KNOT_TICKS * TICK_S
_BLOCK: Final = 256
"""Most knots that are computed at once."""

_KNOTS: Final = 10
"""Knots of a changing range error per correlation length."""

_CYCLE: Final = 256
"""Sequence numbers, after which the gaps between an anchor's beacons repeat."""

_TAG_KEY: Final = 1 << 32
"""Tags are keyed by this and their number, anchors by their identifier."""

_CRYSTAL, _TX_NOISE, _RX_NOISE, _CHANCE, _RANGES = range(1, 6)
"""Purposes of random numbers."""

_NOT_MODELLED: Final = (
    "anchor_biases", "delay_errors", "anchor_outages", "anchor_displacements", "anchor_pair_errors", "body", "warm_ups",
    "diagnostics", "carrier",
)  # fmt: skip
_ENTRY: Final = np.dtype([("anchor", "<u2"), ("sequence", "u1"), ("low", "<u4"), ("high", "u1")])
"""A relayed reception as frames carry it (``air/beacon.HEARD``)."""


def uniforms(seed: int, purpose: int, *numbers: NDArray[np.int64] | int) -> Array:
    """Uniform numbers in (0, 1), a function of the seed, the purpose and whole numbers (SplitMix64)."""
    key: Any = np.uint64(0x9E3779B97F4A7C15)
    with np.errstate(over="ignore"):  # the product wraps
        for number in (seed, purpose, *numbers):
            key = (key ^ np.asarray(number).astype(np.uint64)) + np.uint64(0x9E3779B97F4A7C15)
            key = (key ^ (key >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            key = (key ^ (key >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            key ^= key >> np.uint64(31)
    return np.asarray((key >> np.uint64(11)) + 0.5) * 2.0**-53


def normals(seed: int, purpose: int, *numbers: NDArray[np.int64] | int) -> Array:
    """Standard normals, a function of the seed, the purpose and whole numbers (Box and Muller)."""
    lengths = np.sqrt(-2.0 * np.log(uniforms(seed, purpose, *numbers)))
    return np.asarray(lengths * np.cos(2.0 * np.pi * uniforms(seed, -purpose, *numbers)))


@lru_cache(maxsize=4)
def period_codes_of(site: Site) -> Integers:
    """Codes of the mean periods of a site's anchors once they know how many are in reach, shape (n,)."""
    rate_hz = site.schedule.rate_hz
    return np.array([period_code(suitable_period_s(count, rate_hz)) for count in anchors_in_reach(site).tolist()])


class Heard(Struct, frozen=True, gc=False):
    """A beacon that a tag received."""

    beacon: Beacon
    reception: Reception
    """Without bytes; its host time is the true time of the emission."""
    truth_m: Array
    """True position of the tag at the emission, shape (3,)."""


class _Clocks:
    """Counters of nodes over a window of true time that moves forwards.

    A counter shows its start, the true time and a gain, all in ticks. The noise is the two-state model of
    ``sim/oscillator.py``, sampled exactly from knot to knot.
    """

    def __init__(self, model: OscillatorModel, nodes: Integers, seed: int) -> None:
        self._model, self._nodes, self._seed = model, nodes[:, None], seed
        start, fraction, rate = (uniforms(seed, _CRYSTAL, nodes, -number) for number in (1, 2, 3))
        self.start_ticks: Integers = (start * WRAP_TICKS).astype(np.int64)
        self._begin = (fraction[:, None], model.offset_ppm * 1e-6 * (2.0 * rate - 1.0))
        self._first = 0
        self._gain_ticks, self._rate = self._begin

    def cover(self, from_ticks: float, to_ticks: float) -> None:
        """Move the window; it begins again from true time 0 where it would have to move backwards."""
        first, last = max(int(from_ticks // _KNOT_TICKS), 0), int(to_ticks // _KNOT_TICKS) + 2
        if first < self._first:
            self._first, (self._gain_ticks, self._rate) = 0, self._begin
        while (known := self._gain_ticks.shape[1]) + self._first < last:
            self._extend(min(last - self._first - known, _BLOCK))
            passed = min(max(first - self._first, 0), self._gain_ticks.shape[1] - 1)
            self._gain_ticks, self._first = self._gain_ticks[:, passed:], self._first + passed

    def _extend(self, knots: int) -> None:
        last = self._first + self._gain_ticks.shape[1] - 1
        numbers = np.arange(last, last + knots)
        white, walk = self._model.white_fm, self._model.random_walk_fm
        rate_gain = walk * math.sqrt(_KNOT_S) * normals(self._seed, _CRYSTAL, self._nodes, 2 * numbers)
        own_std_s = math.sqrt(_KNOT_S * (white**2 + (walk * _KNOT_S) ** 2 / 12.0))
        own_s = own_std_s * normals(self._seed, _CRYSTAL, self._nodes, 2 * numbers + 1)
        rates = self._rate[:, None] + np.cumsum(rate_gain, axis=1)
        steps = (rates - rate_gain) * _KNOT_TICKS + (0.5 * rate_gain * _KNOT_S + own_s) * TICK_RATE_HZ
        gains = self._gain_ticks[:, -1:] + np.cumsum(steps, axis=1)
        self._gain_ticks, self._rate = np.concatenate((self._gain_ticks, gains), axis=1), rates[:, -1]

    def gains(self, node: Integers | int, true_ticks: Array | float) -> Array:
        """Gains of nodes at true times within the window."""
        knots = np.maximum(np.asarray(true_ticks) / _KNOT_TICKS - self._first, 0.0)
        knot = np.minimum(knots.astype(np.int64), self._gain_ticks.shape[1] - 2)
        before, after = self._gain_ticks[node, knot], self._gain_ticks[node, knot + 1]
        return np.asarray(before + (knots - knot) * (after - before))

    def shown(self, node: Integers | int, true_ticks: Array, noise_ticks: Array) -> Integers:
        """Whole ticks that nodes' counters, 40 bits, show at true times, with noise."""
        whole = np.floor(true_ticks)
        gains = self.gains(node, true_ticks) + (true_ticks - whole) + noise_ticks
        ticks = self.start_ticks[node] + whole.astype(np.int64) + np.floor(gains + 0.5).astype(np.int64)
        return np.asarray(ticks & TICK_MASK)


class _Frames(Struct, frozen=True):
    """Frames of all anchors in the order of their emission, shape (n,) each."""

    sender: Integers
    """Row of the anchor."""
    number: Integers
    """Counted from the anchor's first frame."""
    tx_ticks: Integers
    """TX stamp, unwrapped."""
    ticks: Array
    """True time of the emission."""


class Tape:
    """Many anchors of protocol 2 and tags that listen; deterministic by its seed."""

    def __init__(
        self,
        site: Site,
        tags: Sequence[Trajectory],
        impairments: Impairments,
        seed: int,
        *,
        dead: NDArray[np.bool_] | None = None,
        survey_std_m: float = 0.0,
    ) -> None:
        """``dead``: which anchors neither send nor receive, shape (anchors,).

        ``survey_std_m``: standard deviation of the anchors' true positions around the stated ones, per axis.

        Raises ValueError: an impairment is not modelled; the message names it.
        """
        _check(impairments)
        ids = np.array([anchor.id for anchor in site.anchors])
        self._ids, self._tags, self._seed, self._impairments = ids, tuple(tags), seed, impairments
        stated_m = anchor_positions(site)
        errors_m = survey_std_m * np.random.default_rng([seed, _RANGES]).standard_normal(stated_m.shape)
        self.true_positions_m: Array = stated_m + errors_m
        """Shape (anchors, 3)."""
        self._dead = np.zeros(len(ids), np.bool_) if dead is None else dead
        channel = impairments.channel
        weakest_dbm = channel.sensitivity_dbm - _AUDIBLE_WIDTHS * channel.sensitivity_width_db
        self._audible_m = 10.0 ** ((channel.tx_power_dbm - FREE_SPACE_LOSS_1_M_DB - weakest_dbm) / 20.0)
        self._capture = 10.0 ** (channel.capture_db / 20.0)
        keys = np.concatenate((ids, _TAG_KEY + np.arange(len(self._tags))))
        self._clocks = _Clocks(impairments.oscillator, keys, seed)
        self._beacons = _Beacons(site)
        codes = period_codes_of(site)
        gaps: Integers = cast("Any", gap_ticks)(ids[:, None], np.arange(_CYCLE), codes[:, None])  # takes arrays as well
        self._ahead_ticks: Integers = np.cumsum(np.concatenate((np.zeros_like(ids)[:, None], gaps), axis=1), axis=1)
        first_ticks = self._clocks.start_ticks[: len(ids)] + _LEAD_TICKS + DELAYED_TX_GRANULARITY_TICKS + gaps[:, -1]
        delays = np.array([anchor.tx_antenna_delay_ticks for anchor in site.anchors])
        self._first_ticks = first_ticks - (first_ticks - delays) % DELAYED_TX_GRANULARITY_TICKS
        self._errors = [_RangeErrors(impairments.range_errors, len(ids), seed, tag) for tag in range(len(tags))]
        self._near: dict[int, NDArray[np.bool_]] = {}
        self._window = (math.inf, -math.inf)
        self._frames: _Frames

    def hear(self, tag: int, from_s: float, to_s: float) -> list[Heard]:
        """The beacons emitted in [from_s, to_s) that a tag receives, in order; cheapest in the order of time.

        Raises ValueError: range errors change, and the span is before one that was asked for.
        """
        frames = self._cover(from_s, to_s)
        begin, end = np.searchsorted(frames.ticks, (from_s * TICK_RATE_HZ, to_s * TICK_RATE_HZ))
        span = np.arange(begin, end)
        times_s = frames.ticks[span] * TICK_S
        points_m = _positions_m(self._tags[tag], times_s)
        arrives, arrivals = self._receive(np.full(len(span), _TAG_KEY + tag), points_m, span)
        span, points_m, times_s = span[arrives], points_m[arrives], times_s[arrives]
        sender, number = frames.sender[span], frames.number[span]
        errors_m = self._errors[tag].at(times_s, points_m, sender, _apart_m(points_m, self.true_positions_m[sender]))
        stamps = self._stamps(_TAG_KEY + tag, len(self._ids) + tag, span, arrivals[arrives] + errors_m / TICK_M)
        relays = self._relays(span)
        rows = zip(
            self._ids[sender].tolist(), (number % _CYCLE).tolist(), (frames.tx_ticks[span] & TICK_MASK).tolist(),
            stamps.tolist(), relays, times_s.tolist(), points_m, strict=True,
        )  # fmt: skip
        return [
            Heard(self._beacons.beacon(anchor, sequence, tx, heard), Reception(b"", rx, time_s), point_m)
            for anchor, sequence, tx, rx, heard, time_s, point_m in rows
        ]

    def _cover(self, from_s: float, to_s: float) -> _Frames:
        """Frames for the receptions of a span, and for the relays that they carry."""
        if from_s < self._window[0] or to_s > self._window[1]:
            from_ticks = max(from_s * TICK_RATE_HZ - 1.01 * _RELAY_AGE_TICKS - _LEAD_TICKS - 2 * _AIR_TICKS, 0.0)
            to_ticks = to_s * TICK_RATE_HZ + 2 * _AIR_TICKS
            self._clocks.cover(from_ticks, to_ticks)
            self._frames, self._window = self._between(from_ticks, to_ticks), (from_s, to_s)
        return self._frames

    def _between(self, from_ticks: float, to_ticks: float) -> _Frames:
        """The frames of all anchors between two true times."""
        rows = np.arange(len(self._ids))
        start, cycle = self._clocks.start_ticks[rows], self._ahead_ticks[:, -1]
        numbers = []
        for true_ticks in (from_ticks, to_ticks):
            own = start + int(true_ticks) + self._clocks.gains(rows, true_ticks).astype(np.int64) - self._first_ticks
            cycles, rest = np.divmod(np.maximum(own, 0), cycle)
            numbers.append(_CYCLE * cycles + (self._ahead_ticks[:, :-1] < rest[:, None]).sum(axis=1))
        sender, at = _spread(np.where(self._dead, 0, numbers[1] - numbers[0]))
        number = numbers[0][sender] + at
        tx_ticks = (
            self._first_ticks[sender] + number // _CYCLE * cycle[sender] + self._ahead_ticks[sender, number % _CYCLE]
        )
        since = (tx_ticks - start[sender]).astype(np.float64)
        ticks = since - self._clocks.gains(sender, from_ticks)
        for _ in range(3):  # each step multiplies the error by the clock's rate, at most 2e-5
            ticks = since - self._clocks.gains(sender, ticks)
        noise = self._impairments.tx_stamp_ps * 1e-12 / TICK_S
        ticks += noise * normals(self._seed, _TX_NOISE, self._ids[sender], number)
        order = np.argsort(ticks, kind="stable")
        return _Frames(sender[order], number[order], tx_ticks[order], ticks[order])

    def _receive(self, listener: Integers, points_m: Array, frames: Integers) -> tuple[NDArray[np.bool_], Array]:
        """Which frames (rows) listeners (keys) at points receive, and the true times at which all arrive, in ticks.

        A frame is lost by its power, by chance, or to one that overlaps it and is not weaker by the capture margin; an
        anchor that sends is nearest to itself, so it receives nothing meanwhile.
        """
        own, channel = self._frames, self._impairments.channel
        sender = own.sender[frames]
        distances_m = _apart_m(points_m, self.true_positions_m[sender])
        powers_dbm = channel.tx_power_dbm - FREE_SPACE_LOSS_1_M_DB - 20.0 * np.log10(np.maximum(distances_m, 0.01))
        margins = (powers_dbm - channel.sensitivity_dbm) / channel.sensitivity_width_db
        chances = 1.0 / (1.0 + np.exp(np.minimum(-margins, 700.0)))
        chances *= (1.0 - channel.loss_probability) * (distances_m <= self._audible_m)
        arrives = uniforms(self._seed, _CHANCE, listener, self._ids[sender], own.number[frames]) < chances
        arrivals = own.ticks[frames] + distances_m / TICK_M
        pairs = np.flatnonzero(arrives)
        reach = _AIR_TICKS + self._audible_m * self._capture / TICK_M
        low, high = (np.searchsorted(own.ticks, own.ticks[frames[pairs]] + sign * reach) for sign in (-1.0, 1.0))
        pair, at = _spread(high - low)
        other, pair = low[pair] + at, pairs[pair]
        others_m = _apart_m(points_m[pair], self.true_positions_m[own.sender[other]])
        apart = np.abs(own.ticks[other] + others_m / TICK_M - arrivals[pair])
        destroys = (apart < _AIR_TICKS) & (others_m < self._capture * distances_m[pair]) & (other != frames[pair])
        arrives[pair[destroys]] = False
        return arrives, arrivals

    def _stamps(self, key: Integers | int, node: Integers | int, frames: Integers, arrivals: Array) -> Integers:
        """RX stamps of frames (rows) at nodes with these keys."""
        own, noise = self._frames, self._impairments.rx_stamp_ps * 1e-12 / TICK_S
        drawn = normals(self._seed, _RX_NOISE, key, self._ids[own.sender[frames]], own.number[frames])
        return self._clocks.shown(node, arrivals, noise * drawn)

    def _relays(self, frames: Integers, candidates: int = _CANDIDATES) -> list[bytes]:
        """The relays in frames (rows) as these carry them: the senders' newest receptions, the most recent first."""
        own = self._frames
        found = [self._candidates(row, candidates) for row in frames.tolist()]
        carrier = np.repeat(np.arange(len(frames)), [len(one) for one in found])
        rows = np.concatenate(found) if found else np.zeros(0, np.int64)
        sender = own.sender[frames[carrier]]
        arrives, arrivals = self._receive(self._ids[sender], self.true_positions_m[sender], rows)
        carrier, rows, sender = carrier[arrives], rows[arrives], sender[arrives]
        stamps = self._stamps(self._ids[sender], sender, rows, arrivals[arrives])
        entries = np.zeros(len(rows), _ENTRY)
        entries["anchor"], entries["sequence"] = self._ids[own.sender[rows]], own.number[rows] % _CYCLE
        entries["low"], entries["high"] = stamps & 0xFFFFFFFF, stamps >> 32
        # Of several receptions of an anchor only the newest, which comes first, is relayed.
        _, newest = np.unique(carrier * len(self._ids) + own.sender[rows], return_index=True)
        kept = np.sort(newest)
        ends = np.searchsorted(carrier[kept], np.arange(len(frames) + 1))
        listed = [entries[kept[begin:end][:MAX_RELAYS]].tobytes() for begin, end in pairwise(ends)]
        full = MAX_RELAYS * _ENTRY.itemsize
        short = [row for row, one in enumerate(found) if len(one) == candidates and len(listed[row]) < full]
        if short:
            for row, one in zip(short, self._relays(frames[short], 4 * candidates), strict=True):
                listed[row] = one
        return listed

    def _candidates(self, row: int, most: int) -> Integers:
        """The newest frames (rows) that a frame's sender may have received in time to relay them, newest first."""
        own, sender = self._frames, int(self._frames.sender[row])
        near = self._near.get(sender)
        if near is None:
            near = _apart_m(self.true_positions_m, self.true_positions_m[sender]) <= self._audible_m
            near[sender] = False
            self._near[sender] = near
        fixed_ticks = own.ticks[row] - _LEAD_TICKS
        oldest, end = np.searchsorted(own.ticks, (fixed_ticks - _RELAY_AGE_TICKS, fixed_ticks - _AFTER_TICKS))
        length = max(2 * most * len(near) // max(int(near.sum()), 1), 1)
        while True:
            begin = max(end - length, oldest)
            found = begin + np.flatnonzero(near[own.sender[begin:end]])
            if len(found) >= most or begin == oldest:
                return np.asarray(found[: -most - 1 : -1])
            length *= 2


class _Beacons:
    def __init__(self, site: Site) -> None:
        self._site, self._pages = site.id, tuple(map(_on_air, site_pages_of(site)))
        self._issue = site_issue(self._pages)
        self._positions = {anchor.id: stated_position(site, anchor) for anchor in site.anchors}
        ids = [anchor.id for anchor in site.anchors]
        self._period_codes = dict(zip(ids, period_codes_of(site).tolist(), strict=True))

    def beacon(self, anchor: int, sequence: int, tx_ticks: int, heard: bytes) -> Beacon:
        """A beacon as decoded from its frame."""
        return Beacon(
            self._site,
            anchor,
            sequence,
            tx_ticks,
            self._issue,
            self._period_codes[anchor],
            self._positions[anchor],
            PackedHeard(heard),
            0,
            site_page_for(self._pages, sequence, anchor),
        )


def _on_air(page: Page) -> Page:
    """A page as its bytes state it: noise in single precision, lengths in millimetres."""
    decoded = decode_page(encode_page(page))
    assert decoded is not None and not isinstance(decoded, Malformed)
    return decoded


class _RangeErrors:
    """Errors of a tag's ranges to all anchors (``RangeErrorModel``); changing ones are drawn at knots."""

    def __init__(self, model: RangeErrorModel, anchors: int, seed: int, tag: int) -> None:
        self._model, self._draw = model, np.random.default_rng([seed, _RANGES, tag])
        self._constant_m = model.constant_m * self._draw.uniform(-1.0, 1.0, anchors)
        self._step = (model.correlation_s or model.correlation_m or math.inf) / _KNOTS
        self._first, self._knots = 0, self._draw.standard_normal((1, anchors))
        self._last: tuple[Array, float] | None = None
        self._last_s = 0.0

    def at(self, times_s: Array, points_m: Array, sender: Integers, distances_m: Array) -> Array:
        """Errors in metres of frames in the order of time; the sender is a row of the anchors."""
        model = self._model
        slopes_m = model.slope_m * np.clip(distances_m / SLOPE_MIDDLE_M - 1.0, -1.0, 1.0)
        errors_m = self._constant_m[sender] + slopes_m
        if model.changing_m > 0.0 and len(times_s):
            if times_s[0] < self._last_s:
                raise ValueError("range errors that change are drawn in the order of time; the span is an earlier one")
            self._last_s = float(times_s[-1])
            passed = (times_s if model.correlation_s is not None else self._walk(points_m)) / self._step
            knot = passed.astype(np.int64)
            self._extend(int(knot[0]), int(knot[-1]) + 1)
            before, after = (self._knots[knot + more - self._first, sender] for more in (0, 1))
            errors_m += model.changing_m * (before + (passed - knot) * (after - before))
        return np.asarray(errors_m)

    def _walk(self, points_m: Array) -> Array:
        """Path lengths along straight lines from frame to frame."""
        last_m, walked_m = (points_m[0], 0.0) if self._last is None else self._last
        steps_m = np.linalg.norm(np.diff(points_m, axis=0, prepend=last_m[None]), axis=1)
        lengths_m = walked_m + np.cumsum(steps_m)
        self._last = points_m[-1], float(lengths_m[-1])
        return np.asarray(lengths_m)

    def _extend(self, first: int, last: int) -> None:
        kept, rows = math.exp(-1.0 / _KNOTS), [self._knots[-1]]
        for _ in range(self._first + len(self._knots), last + 1):
            rows.append(kept * rows[-1] + math.sqrt(1.0 - kept**2) * self._draw.standard_normal(len(rows[-1])))
        self._knots = np.concatenate((self._knots, np.array(rows[1:]).reshape(-1, len(rows[0]))))[first - self._first :]
        self._first = first


def _check(impairments: Impairments) -> None:
    plain = Impairments()
    pairs: list[tuple[str, Any, Any]] = [
        (name, getattr(impairments, name), getattr(plain, name)) for name in _NOT_MODELLED
    ]
    pairs += [
        (f"channel.{name}", getattr(impairments.channel, name), getattr(plain.channel, name))
        for name in ("nlos_probability", "power_bias")
    ]
    pairs.append(("oscillator.temperature", impairments.oscillator.temperature, None))
    for name, value, default in pairs:
        if value != default:
            raise ValueError(f"impairments.{name} is {value!r}; it should be {default!r}: a tape does not model it")


def _positions_m(path: Trajectory, times_s: Array) -> Array:
    """Positions on a path at ascending times, shape (n, 3)."""
    positions_m, begin = np.empty((len(times_s), 3)), 0
    while begin < len(times_s):
        piece = path.piece(float(times_s[begin]))
        end = max(int(np.searchsorted(times_s, piece.end_s)), begin + 1)
        dt_s = (times_s[begin:end] - piece.origin_s)[:, None]
        positions_m[begin:end] = piece.position_m + dt_s * (piece.velocity_mps + 0.5 * dt_s * piece.acceleration_mps2)
        begin = end
    return positions_m


def _apart_m(some_m: Array, others_m: Array) -> Array:
    """Distances between points, shape (n,)."""
    away_m = some_m - others_m
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", away_m, away_m)))


def _spread(counts: Integers) -> tuple[Integers, Integers]:
    """For each row as many entries as it counts: the row, and the entry's number in it."""
    rows = np.repeat(np.arange(len(counts)), counts)
    return rows, np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
