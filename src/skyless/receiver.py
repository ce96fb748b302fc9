"""``Receiver``: the protocol machine of one tag. Bytes and ticks in, fixes out; no I/O, no clock.

It needs nothing but beacons: anchors, schedule and noise figures come from the almanac on the air.
"""

from collections import Counter
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.air.almanac_book import AlmanacBook
from skyless.air.beacon import Beacon
from skyless.air.codec import decode_cached
from skyless.air.malformed import Malformed
from skyless.air.reception import Reception
from skyless.air.schedule import Schedule, schedule_from_page
from skyless.clocks.filter import clock_noise
from skyless.constants import TICK_M
from skyless.positioning.fix import Fix, NoFixReason
from skyless.positioning.observation import Method, Observation
from skyless.positioning.snapshots import SnapshotMethod, Snapshots, SnapshotSettings
from skyless.positioning.tracker import TrackerSettings
from skyless.positioning.tracking import Tracking
from skyless.ticks import Unwrapper, nearest
from skyless.uncertainty.tdoa import stamp_variance_m2

METHODS: Final = (*(str(method) for method in SnapshotMethod), "tracker")
"""Names of the positioning methods."""

MAX_RATE_ERROR: Final = 50e-6
"""An anchor's clock and the tag's cannot drift apart faster: two crystals of 20 ppm, and room for motion."""

STAMPS_BEFORE_RESTART: Final = 3
"""So many impossible stamps of one anchor in a row mean that its counter has started anew."""


class _Track(Struct):
    """The last stamps of one anchor, unwrapped."""

    rx_ticks_tag: int
    tx_ticks: int
    sequence: int
    impossible: int = 0


class Receiver:
    """One listening tag."""

    def __init__(
        self,
        method: str = "tracker",
        *,
        site: int | None = None,
        qa: float = 0.3,
        z_bounds_m: tuple[float, float] | None = None,
    ) -> None:
        """Make a tag that knows nothing yet.

        ``method`` is one of ``METHODS``; ``site`` the only site to listen to, by default the first that is heard;
        ``qa`` the tag's agility in m²/s³ (``tracker``); ``z_bounds_m`` decides between mirror solutions.

        Raises:
            ValueError: there is no such method.
        """
        if method not in METHODS:
            raise ValueError(f"method {method!r} is not one of {', '.join(METHODS)}")
        self.counters: Counter[str] = Counter()
        self.reason: NoFixReason = NoFixReason.NO_BEACONS
        self.almanac = AlmanacBook()
        self._method_name = method
        self._site = site
        self._qa = qa
        self._z_bounds_m = z_bounds_m
        self._own_ticks = Unwrapper()
        self._tracks: dict[int, _Track] = {}
        self._master_scale: tuple[int, int] | None = None
        self._method: Method | None = None
        self._issue: int | None = None
        self._schedule: Schedule | None = None
        self._positions: dict[int, NDArray[np.float64]] = {}

    @property
    def method(self) -> Method | None:
        """The positioning method at work, None before the almanac is known."""
        return self._method

    def hear(self, reception: Reception) -> Fix | None:
        """Take a frame off the air; a fix if it made one, else ``reason`` says why not.

        What does not belong here is counted in ``counters`` and dropped; nothing on the air raises.
        """
        beacon = decode_cached(reception.frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
            return None
        if self._site is None:
            self._site = beacon.site
        if beacon.site != self._site:
            self.counters["foreign-site"] += 1
            return None
        rx_ticks = self._own_ticks.unwrap(reception.rx_ticks, reception.host_s)
        tx_ticks = self._unwrap_tx(beacon, rx_ticks)
        if tx_ticks is None:
            return None
        self.counters["heard"] += 1
        self._read_almanac(beacon)
        anchor_m = self._positions.get(beacon.anchor)
        if self._method is None or self._schedule is None or anchor_m is None:
            self.reason = NoFixReason.NO_ALMANAC
            return None
        result = self._method.hear(self._observation(beacon, self._schedule, anchor_m, rx_ticks, tx_ticks))
        if isinstance(result, Fix):
            self.counters["fixes"] += 1
            return result
        self.reason = result
        if result is NoFixReason.RESIDUALS:
            self.counters["outlier"] += 1
        return None

    def _unwrap_tx(self, beacon: Beacon, rx_ticks: int) -> int | None:
        """The anchor's TX stamp on its own unwrapped scale; None for a repeated frame or an impossible stamp."""
        track = self._tracks.get(beacon.anchor)
        if track is None:
            self._tracks[beacon.anchor] = _Track(rx_ticks, beacon.tx_ticks, beacon.sequence)
            return beacon.tx_ticks
        elapsed = rx_ticks - track.rx_ticks_tag
        tx_ticks = nearest(beacon.tx_ticks, track.tx_ticks + elapsed)
        fault = _stamp_fault(beacon, track, elapsed, tx_ticks)
        if fault is None:
            track.rx_ticks_tag, track.tx_ticks = rx_ticks, tx_ticks
            track.sequence, track.impossible = beacon.sequence, 0
            return tx_ticks
        self.counters[fault] += 1
        track.impossible += fault == "impossible-stamp"
        if track.impossible >= STAMPS_BEFORE_RESTART:
            del self._tracks[beacon.anchor]
            self.counters["anchor-restart"] += 1
        return None

    def _read_almanac(self, beacon: Beacon) -> None:
        """Keep the page; a new issue of the almanac, or its completion, makes the method anew."""
        book = self.almanac
        if beacon.page is not None and not (book.complete and beacon.almanac_issue == book.issue):
            book.hear(beacon.almanac_issue, beacon.page)
            self._positions = {anchor: np.array(place) for anchor, place in book.anchors_m.items()}
        if book.issue != self._issue:
            self._method = None
        if self._method is None and book.schedule is not None and book.noise is not None:
            self._issue = book.issue
            self._schedule = schedule_from_page(book.schedule)
            self._method = self._new_method()

    def _new_method(self) -> Method:
        schedule, noise = self.almanac.schedule, self.almanac.noise
        assert schedule is not None
        assert noise is not None
        tx_variance = stamp_variance_m2(noise.tx_stamp_s, rounded=False)
        rx_variance = stamp_variance_m2(noise.rx_stamp_s, rounded=True)
        if self._method_name != "tracker":
            settings = SnapshotSettings(
                schedule.master, schedule.anchors, tx_variance, rx_variance, schedule.tag_height_m, self._z_bounds_m
            )
            return Snapshots(SnapshotMethod(self._method_name), settings)
        clock = clock_noise(noise.white_fm, noise.random_walk_fm)
        return Tracking(
            TrackerSettings(
                qa=self._qa,
                white=clock.white,
                walk=clock.walk,
                stamp_variance_m2=tx_variance + rx_variance,
                height_m=schedule.tag_height_m,
            ),
            self._z_bounds_m,
        )

    def _observation(
        self, beacon: Beacon, schedule: Schedule, anchor_m: NDArray[np.float64], rx_ticks: int, tx_ticks: int
    ) -> Observation:
        heard = beacon.master_heard
        ticks_master, fraction, variance_m2 = self._master_time(beacon, rx_ticks)
        return Observation(
            beacon.anchor,
            anchor_m,
            schedule.round_of(beacon.superframe, beacon.slot),
            beacon.sequence,
            rx_ticks,
            tx_ticks,
            None if heard is None else heard.sequence,
            None if heard is None else nearest(heard.rx_ticks, tx_ticks),
            ticks_master,
            fraction,
            variance_m2,
        )

    def _master_time(self, beacon: Beacon, rx_ticks: int) -> tuple[int | None, float, float]:
        """TX time on the master's scale: unwrapped whole ticks, fraction, variance in m²."""
        time = beacon.master_time
        if time is None:
            return None, 0.0, 0.0
        whole, fraction = divmod(time.tx_subticks_master, 256)
        if self._master_scale is not None:
            last_whole, last_rx = self._master_scale
            whole = nearest(whole, last_whole + rx_ticks - last_rx)
        self._master_scale = (whole, rx_ticks)
        return whole, fraction / 256.0, (time.std_ticks * TICK_M) ** 2


def _stamp_fault(beacon: Beacon, track: _Track, elapsed: int, tx_ticks: int) -> str | None:
    """Why a stamp cannot follow the last one of its anchor, None if it can; 64 ticks (0.3 m) allow for noise."""
    if tx_ticks == track.tx_ticks and beacon.sequence == track.sequence:
        return "duplicate"
    if elapsed <= 0:
        return "out-of-order"
    if abs(tx_ticks - track.tx_ticks - elapsed) > MAX_RATE_ERROR * elapsed + 64:
        return "impossible-stamp"
    return None
