"""Observations out of beacons: stamps unwrapped, variances of receptions, times of fixes."""

import math
from collections import Counter
from typing import Final

from msgspec import Struct

from skyless.core.air.beacon import Beacon
from skyless.core.air.frame import AnyBeacon
from skyless.core.constants import MAX_DRIFT, TICK_S
from skyless.core.kernels.arrays import Array
from skyless.core.observation import Observation
from skyless.core.ticks import HALF_WRAP_TICKS, TICK_MASK, difference, from_seconds, wrap


def observation_of(
    beacon: Beacon,
    relays: bytes,
    anchor_m: Array,
    anchor_std_m: float,
    rx_ticks: int,
    tx_ticks: int,
    rx_variance_factor: float,
) -> Observation:
    """One observation of a beacon; ``relays``: ``packed_relays``."""
    return Observation(
        beacon.anchor, anchor_m, 0, beacon.sequence, rx_ticks, tx_ticks, None, None, None, 0.0, 0.0, (), None,
        rx_variance_factor, relays, anchor_std_m,
    )  # fmt: skip


# Stamps


STAMPS_BEFORE_RESTART: Final = 3
"""This number of impossible stamps of one anchor in a row mean that its counter has restarted, ..."""

RESTART_SILENCE_TICKS: Final = from_seconds(0.2)
RESTART_SILENCE_PERIODS: Final = 4
"""... if none has fitted for both of these: forged frames in between do not replace an anchor that still sends."""

MAX_TRACKS: Final = 256
"""More anchors than there are in reach; with more identifiers on the air, that received longest ago is forgotten, those
of a single stamp first."""

NOISE_TICKS: Final = 64
"""0.3 m allow for the noise of two stamps."""


class _Track(Struct):
    """The last stamps of one anchor, unwrapped."""

    rx_ticks_tag: int
    tx_ticks: int
    sequence: int
    impossible: int = 0
    is_single: bool = True
    """Whether no stamp after the first has fitted."""
    rival: tuple[int, int] | None = None
    """The tag's stamp and the TX stamp of the last frame that did not fit a single one."""


class StampTracks(Struct):
    """What ``AnchorStamps`` keeps."""

    newest_rx_ticks: int | None = None
    """RX stamp of the newest accepted frame, unwrapped: one impossible stamp must not make others late."""
    of_anchor: dict[int, _Track] = {}


class AnchorStamps:
    """Unwraps every anchor's counter along the tag's own; counts what it rejects in ``counters``."""

    def __init__(self, counters: Counter[str], tracks: StampTracks | None = None) -> None:
        """``tracks``: those to continue with."""
        self._counters = counters
        self.tracks = tracks or StampTracks()

    def forget(self) -> None:
        """Start again."""
        self.tracks = StampTracks()

    def unwrap(self, beacon: AnyBeacon, rx_ticks: int, period_ticks: int = 0) -> int | None:
        """TX stamp on the anchor's own unwrapped scale; None if the frame is repeated, late, or its stamp impossible.

        ``rx_ticks`` is the tag's own reading, unwrapped; ``period_ticks`` the time between two frames of an anchor,
        as far as it is known. An anchor's first stamp keeps its own value.
        """
        tracks = self.tracks
        track, newest = tracks.of_anchor.get(beacon.anchor), tracks.newest_rx_ticks
        if newest is not None and rx_ticks <= newest:
            repeated = track is not None and _is_repeated(beacon, track)
            self._counters["duplicate" if repeated else "out-of-order"] += 1
            return None
        if track is None:
            tracks.newest_rx_ticks = rx_ticks
            return self._begin(beacon, rx_ticks)
        elapsed = rx_ticks - track.rx_ticks_tag
        least = track.tx_ticks + elapsed - HALF_WRAP_TICKS
        off = ((beacon.tx_ticks - least) & TICK_MASK) - HALF_WRAP_TICKS
        if abs(off) > MAX_DRIFT * elapsed + NOISE_TICKS:
            silence_ticks = max(RESTART_SILENCE_TICKS, RESTART_SILENCE_PERIODS * period_ticks)
            self._reject(beacon, track, rx_ticks, is_silent=elapsed > silence_ticks)
            return None
        track.rx_ticks_tag = tracks.newest_rx_ticks = rx_ticks
        track.tx_ticks = tx_ticks = least + HALF_WRAP_TICKS + off
        track.sequence, track.impossible, track.is_single = beacon.sequence, 0, False
        return tx_ticks

    def _begin(self, beacon: AnyBeacon, rx_ticks: int) -> int:
        tracks = self.tracks.of_anchor
        if len(tracks) >= MAX_TRACKS:
            del tracks[min(tracks, key=lambda anchor: (not tracks[anchor].is_single, tracks[anchor].rx_ticks_tag))]
        tracks[beacon.anchor] = _Track(rx_ticks, beacon.tx_ticks, beacon.sequence)
        return beacon.tx_ticks

    def _reject(self, beacon: AnyBeacon, track: _Track, rx_ticks: int, *, is_silent: bool) -> None:
        """Count the stamp; after a few that are impossible the next one of a silent anchor is a beginning.

        Where only the first stamp stands against it, which may have been a false one, two that fit each other are.
        """
        if _is_repeated(beacon, track):
            self._counters["duplicate"] += 1
            return
        self._counters["impossible-stamp"] += 1
        track.impossible += 1
        if track.is_single and track.rival is not None and _fits(*track.rival, rx_ticks, beacon.tx_ticks):
            self.tracks.of_anchor[beacon.anchor] = _Track(rx_ticks, beacon.tx_ticks, beacon.sequence, is_single=False)
            return
        track.rival = (rx_ticks, beacon.tx_ticks)
        if track.impossible >= STAMPS_BEFORE_RESTART and is_silent:
            del self.tracks.of_anchor[beacon.anchor]
            self._counters["anchor-restart"] += 1


def _fits(before_rx_ticks: int, before_tx_ticks: int, rx_ticks: int, tx_ticks: int) -> bool:
    """Whether a counter may have gone from one stamp (40 bits) to the next by the time on the tag's."""
    elapsed = rx_ticks - before_rx_ticks
    return abs(difference(tx_ticks, wrap(before_tx_ticks + elapsed))) <= MAX_DRIFT * elapsed + NOISE_TICKS


def _is_repeated(beacon: AnyBeacon, track: _Track) -> bool:
    return wrap(track.tx_ticks) == beacon.tx_ticks and track.sequence == beacon.sequence


# Paths that look blocked


CLEAR_DB: Final = 7.0
BLOCKED_DB: Final = 11.0
"""Up to the former nothing changes, from the latter on all that can: the maker's 6 and 10, and 1 dB. Lines of sight of
the UTIL data set have up to 8.4 dB, paths through metal, the only ones that are much later, from 11.3."""

MAX_VARIANCE_FACTOR: Final = 36.0
"""Factor on the variance of a blocked path: metal made messages 0.2 to 0.4 m late, 4 to 8 times what noise does."""


def variance_factor(rx_power_dbm: float | None, first_path_power_dbm: float | None) -> float:
    """Factor on the variance of a reception, from 1 to ``MAX_VARIANCE_FACTOR``; it grows with the powers' difference.

    Where a power is missing, not finite or impossible (a first path above the total) the factor is 1.
    """
    if rx_power_dbm is None or first_path_power_dbm is None:
        return 1.0
    difference_db = rx_power_dbm - first_path_power_dbm
    if not CLEAR_DB < difference_db < math.inf:
        return 1.0
    part = min((difference_db - CLEAR_DB) / (BLOCKED_DB - CLEAR_DB), 1.0)
    return float(MAX_VARIANCE_FACTOR ** (part * part * (3.0 - 2.0 * part)))


WEAK_FACTOR: Final = math.sqrt(MAX_VARIANCE_FACTOR)
"""From this factor on an anchor says that the first path of a reception that it relays was weak: 9 dB."""


def is_weak_first_path(rx_power_dbm: float | None, first_path_power_dbm: float | None) -> bool:
    """Whether a reception may be late, as its first path is weak; False where a power is missing or impossible."""
    return variance_factor(rx_power_dbm, first_path_power_dbm) >= WEAK_FACTOR


# The time of fixes


FLIGHT_SLACK_TICKS: Final = from_seconds(1e-6)
"""Flight times differ between anchors by less than this (300 m)."""


class FixTime(Struct):
    """Counts from the first fix of a receiver and never goes back, also where master or method change."""

    first_ticks_master: int | None = None
    last_ticks_master: int = 0
    last_rx_ticks_tag: int = 0

    def time_s(self, ticks_master: int, rx_ticks_tag: int) -> float:
        """Time in seconds of a fix that holds at this master time, given the tag's reading for it, both unwrapped."""
        if self.first_ticks_master is None:
            self.first_ticks_master = ticks_master
        else:
            elapsed = rx_ticks_tag - self.last_rx_ticks_tag
            off = ticks_master - self.last_ticks_master - elapsed
            if elapsed <= 0 or (abs(off) > FLIGHT_SLACK_TICKS and abs(off) > MAX_DRIFT * elapsed + FLIGHT_SLACK_TICKS):
                self.first_ticks_master += off + elapsed - max(elapsed, 1)
        self.last_ticks_master, self.last_rx_ticks_tag = ticks_master, rx_ticks_tag
        return (ticks_master - self.first_ticks_master) * TICK_S
