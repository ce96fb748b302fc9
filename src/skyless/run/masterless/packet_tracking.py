"""``joint`` for systems without a master, which uses their packets directly instead of time differences.

Stamps are unwrapped along the tag's clock, antenna delays are subtracted from relayed receptions (``RelayDelays``), and
unusable data are counted. The filter decides which measurements are used.
"""

from collections import Counter, deque
from collections.abc import Mapping
from functools import partial
from math import dist, log, sqrt
from typing import Final

import numpy as np

from skyless.core.air.masterless_packets import Packet, Point, Relay
from skyless.core.estimator.settings import TUNING, EstimatorSettings
from skyless.core.fix import Fix, NoFixReason
from skyless.core.integrity import CONTRADICTED, SOUND, UNAVAILABLE
from skyless.core.motion_sample import MotionSample, SampleClock
from skyless.core.tag.joint import Estimation, Observation
from skyless.core.ticks import (
    LAST_TICKS,
    SPEED_OF_LIGHT_MPS,
    TICK_M,
    TICK_RATE_HZ,
    TICK_S,
    FixTime,
    Unwrapper,
    continued,
    fix_time_s,
    nearest,
)
from skyless.run.masterless.difference_tracking import DIFFERENCES, Corners, is_within, neighbourhood_m
from skyless.run.masterless.pair_engine import MAX_ANCHORS, remember
from skyless.run.masterless.stamp_watch import OFTEN, StampWatch
from skyless.site.anchor_names import anchor_name
from skyless.site.survey.anchor_errors import NO_BIAS, SLOPE_NEAREST_M, DifferenceCalibration, RelayDelays

MASTERLESS_RANDOM_WALK_FM: Final = 5e-9
"""Random walk of the oscillators, 1/√s. Captures of TDoA3 anchors show 1e-9 to 7e-9; too much costs little."""

MASTERLESS: Final = DIFFERENCES.changed(
    gate=4.0,
    white=EstimatorSettings().white,
    walk=(MASTERLESS_RANDOM_WALK_FM * SPEED_OF_LIGHT_MPS) ** 2,
    drop_s=EstimatorSettings().drop_s,
    rx_variance_m2=2e-3,
    slope_std_m=0.05,
    phase_std_m=0.006,
    phase_wander=0.1,
    stationary_s=0.0,
)
"""Range errors are as in ``DIFFERENCES``. In captures of TDoA3 anchors each reception has its own error of 4 cm.
Phases have less weight than possible, as heights and exact places of recorded anchors are unknown."""

DL_TDOA: Final = EstimatorSettings(qa=DIFFERENCES.qa)
"""For FiRa radios, of which there are no recordings yet: a site with typical errors is assumed."""

DL_TDOA_ONE_WAY: Final = DL_TDOA.changed(
    pair_std_m=0.0, survey_std_m=0.0, range_std_m=sqrt(DL_TDOA.range_std_m**2 + 3.0 * DL_TDOA.survey_std_m**2)
)
"""The same if only one anchor of each pair relays the other. The constant error of their range cannot be separated from
their clocks then, so it counts, with the survey's, as an error of the tag's range."""

PERIOD_S: Final = 0.15
"""Least period of anchors that the filter assumes; some send once a second."""

RELAY_MAX_AGE_S: Final = 0.5
"""Greatest age of a relayed packet's reception, as a 7-bit sequence number recurs."""

RESTART_IN_ROW: Final = 3
"""Consecutive impossible stamps of an anchor that mean that its counter has restarted."""

NOT_CALIBRATED: Final = (
    "Not calibrated{}: no protection level. skyless calibrate --at X,Y,Z finds the anchors' constants from a recording "
    "at a known place; bias_m in the table of anchors states them (0: known to be none)"
)

BACK_IN_ROW: Final = 8
"""Consecutive packets from before the newest that mean that the tag's counter has restarted."""


_RECENT_TICKS: Final = 10 * TICK_RATE_HZ
"""Time after its last packet for which an anchor counts as heard."""
_SLOWER: Final = 2.5
"""Factor on the period at which a filter for faster anchors would lose them."""


class _Anchor:
    """One anchor at the tag: its position, its newest stamps, and the stamps of its latest packets."""

    __slots__ = ("anchor_m", "heard", "impossible", "intervals", "position_m", "rx_ticks", "tx_ticks")

    def __init__(self, position_m: Point, tx_ticks: int, rx_ticks: int) -> None:
        self.position_m = position_m
        self.anchor_m = np.array(position_m)
        self.tx_ticks, self.rx_ticks = tx_ticks, rx_ticks
        self.impossible = 0
        self.intervals: deque[int] = deque(maxlen=4)
        """Newest times between two packets."""
        self.heard: dict[int, tuple[int, int]] = {}
        """Sequence number → unwrapped (tx_ticks of the anchor, rx_ticks of the tag)."""

    def update(self, tx_counter: int, rx_ticks: int, bits: int) -> bool:
        """Process the stamps of a packet. Returns False if no crystal could get from the newest to these."""
        tx_ticks = continued(tx_counter, self.tx_ticks, rx_ticks - self.rx_ticks, bits)
        if tx_ticks is None:
            self.impossible += 1
            return False
        self.intervals.append(rx_ticks - self.rx_ticks)
        self.tx_ticks, self.rx_ticks, self.impossible = tx_ticks, rx_ticks, 0
        return True


class PacketTracking:
    """Tracks one tag that receives packets of anchors without a master. No I/O; unusable data are counted."""

    def __init__(
        self,
        settings: EstimatorSettings,
        anchors_m: Mapping[int, Point],
        tx_bits: int = 32,
        z_bounds_m: tuple[float, float] | None = None,
        calibration: DifferenceCalibration | None = None,
        one_way: EstimatorSettings | None = None,
    ) -> None:
        """``anchors_m``: the anchors' positions; for others, positions in packets are used.

        ``tx_bits``: width of the anchors' stamps. ``calibration`` is subtracted from the tag's receptions; without one
        the anchors' antenna delays are estimated from their ranging of each other. ``one_way``: settings to use until
        two anchors have relayed each other, for DL-TDoA; its fixes have no protection level without a calibration, as
        constants of half a metre are usual.
        """
        self.reason = NoFixReason.NO_BEACONS
        self.time_s = 0.0
        """Time of the newest fix, by the tag's clock since its first packet."""
        self.position_m: Point | None = None
        """Position of the newest fix."""
        self.used = False
        """Whether the filter used the reception of the last packet."""
        self._tx_bits = tx_bits
        self._positions_m = dict(anchors_m)
        self._surveyed = frozenset(anchors_m)
        self._anchors: dict[int, _Anchor] = {}
        self._delays = RelayDelays(self._positions_m, estimate=calibration is None)
        self._calibration = calibration
        self._tag_clock, self._sample_clock = Unwrapper(), SampleClock()
        self._newest_rx_ticks: int | None = None
        self._back_in_row = 0
        self._time = FixTime()
        self._settings, self._z_bounds_m = settings if one_way is None else one_way, z_bounds_m
        self._both_ways = settings
        self._pairs: set[tuple[int, int]] | None = None if one_way is None else set()
        """Pairs of listener and sender in relays, until two anchors have relayed each other."""
        self._watch, self._faults, self._has_new_faults = StampWatch(), 0, False
        self._is_often_late = False
        self._has_addresses = one_way is not None  # those of FiRa
        self.tracking = self._new_tracking()
        """The filter."""
        self._area_m: Corners = ((), ())
        self._drops: Counter[str] = Counter()
        self._rejected_before = self._rejected_now = 0

    @property
    def anchors_m(self) -> Mapping[int, Point]:
        """Known positions, surveyed or stated in packets."""
        return self._positions_m

    @property
    def newest_s(self) -> float:
        """Reception time of the newest usable packet, on the scale of fixes' times."""
        return ((self._newest_rx_ticks or 0) - self._time.first_ticks_master) * TICK_S

    @property
    def drops(self) -> Counter[str]:
        """Unused data, by reason."""
        self._count_relays()
        return self._drops + Counter({"relay-outlier": self._rejected_before + self._rejected_now})

    @property
    def contradictions_m(self) -> Mapping[tuple[int, int], float]:
        """Pairs of anchors whose own ranging contradicts the positions; fixes then have no protection level."""
        return self._delays.contradictions_m

    @property
    def _uncalibrated(self) -> list[int]:
        """Anchors heard recently whose constants are unknown; those of Bitcraze's systems are small."""
        if not self._has_addresses:
            return []
        known = {} if self._calibration is None else self._calibration.anchors
        return [anchor for anchor in self._heard_recently() if anchor not in known]

    @property
    def notes(self) -> tuple[str, ...]:
        """What is wrong with the anchors, in sentences."""
        names = partial(anchor_name, addresses=self._has_addresses)
        own = [
            f"Anchor {names(anchor)} runs on its own clock ({ppm:+.1f} ppm): its time base is lost"
            for anchor, ppm in sorted(self._watch.own_clocks_ppm.items())
        ]
        flips = [
            f"Stamps of anchor {names(anchor)} flip between two values {gap_m:.1f} m apart: no protection level"
            for anchor, gap_m in sorted(self._watch.flips_m.items())
        ]
        late = () if flips or not self._is_often_late else ("Receptions are often late: no protection level",)
        without = sorted(self._uncalibrated)
        which = "" if self._calibration is None else f" ({', '.join(map(names, without))})"
        motion = self.tracking.estimator.motion_note
        others = ((NOT_CALIBRATED.format(which),) if without else ()) + ((motion,) if motion else ())
        return (*own, *flips, *late, *others)

    def hear_motion(self, sample: MotionSample) -> bool:
        """Process what a motion sensor shows, as ``Receiver.hear_motion`` does; packets must have the host's time."""
        sample.check()
        ticks = self._sample_clock.ticks(self._tag_clock, sample.time_s)
        is_used = ticks is not None and self.tracking.estimator.hear_motion(ticks, sample)
        self._drops["late-motion"] += ticks is not None and not is_used
        return is_used

    def on_packet(self, packet: Packet) -> Fix | None:
        """Process one packet. Returns a fix, or None with the ``reason``.

        A fix's ``time_s`` is since the first packet, by the tag's clock.
        """
        self.used = False
        anchor = self._unwrap(packet)
        if anchor is None:
            return None
        fault = self._watch.check(
            packet.anchor, anchor.rx_ticks, anchor.tx_ticks, claims_common_time=packet.claims_common_time
        )
        if self._watch.changes > self._faults or (self._has_new_faults and self._watch.is_ready):
            self._has_new_faults, self._faults = self._watch.changes > self._faults, self._watch.changes
            self._begin_again()  # at once, and when all faults of that kind have shown
        if fault is not None:
            self._drops[fault] += 1
            self.reason = NoFixReason.RESIDUALS
            return None
        self._expect_period()
        relays, phases = [], []
        for relay in packet.relays:
            rx_ticks = self._relayed(packet.anchor, anchor, relay)
            if isinstance(rx_ticks, str):
                self._drops[rx_ticks] += 1
            else:
                relays.append((relay.anchor, relay.sequence, rx_ticks))
                phases.append(_phase_of(relay))
                if self._pairs is not None:
                    self._look_both_ways(packet.anchor, relay.anchor)
        rx_ticks = anchor.rx_ticks if self._calibration is None else self._calibrated(packet.anchor, anchor)
        observation = Observation(
            packet.anchor,
            anchor.anchor_m,
            packet.sequence,
            rx_ticks,
            anchor.tx_ticks,
            tuple(relays),
            _phase_of(packet),
            tuple(phases),
        )
        status = self.tracking.estimator.state.status
        self._is_often_late = max(status.late_share, status.rejected_share) > OFTEN  # as of flips in slow rounds
        is_wrong = self._watch.flips_m or self._delays.contradictions_m or self._is_often_late
        is_known = self._watch.is_ready and not self._uncalibrated
        self.tracking.estimator.withhold_levels(CONTRADICTED if is_wrong else SOUND if is_known else UNAVAILABLE)
        fix = self.tracking.update(observation)
        self.used = isinstance(fix, Fix)
        if not isinstance(fix, Fix):
            self._count_relays()
            if fix is NoFixReason.RESIDUALS:
                self._drops["outlier"] += 1
                if packet.anchor in self.tracking.excluded:
                    fix = self.tracking.coast(observation)
        return self._checked(fix)

    def _look_both_ways(self, listener: int, sender: int) -> None:
        """Restart with the settings for pairs that relay each other, once there is one."""
        assert self._pairs is not None
        if (sender, listener) in self._pairs:
            self._settings, self._pairs = self._both_ways, None
            self._begin_again()
        else:
            self._pairs.add((listener, sender))

    def _expect_period(self) -> None:
        """Let the filter expect the anchors' present period; if they have become much slower, begin again with it."""
        periods = sorted([min(one.intervals) for one in self._heard_recently().values() if one.intervals])
        period_s = max(periods[len(periods) // 2] * TICK_S if periods else 0.0, PERIOD_S)
        if period_s > _SLOWER * self.tracking.course.superframe_s and not self.tracking.is_starting:
            self._begin_again()
        if self.tracking.is_starting:
            self.tracking.expect_period(period_s)

    def _heard_recently(self) -> dict[int, _Anchor]:
        after = (self._newest_rx_ticks or 0) - _RECENT_TICKS
        return {anchor: one for anchor, one in self._anchors.items() if one.rx_ticks > after}

    def _begin_again(self) -> None:
        """Search for a new start."""
        self._count_relays()
        self.tracking = self._new_tracking()

    def _new_tracking(self) -> Estimation:
        return Estimation(self._settings, self._z_bounds_m, self._time, PERIOD_S)

    def _checked(self, fix: Fix | NoFixReason) -> Fix | None:
        """The fix if it is accurate enough and near the anchors, as time differences have no information elsewhere."""
        if isinstance(fix, Fix):
            x_m, y_m, z_m = fix.position_m.tolist()
            self.position_m, self.time_s = (x_m, y_m, z_m), fix.time_s
            covariance = fix.covariance_m2
            if not is_within(self._area_m, fix.position_m[:2].tolist()):
                fix = NoFixReason.NOT_CONVERGED
                self.tracking = self._new_tracking()
            elif covariance.item(0) + covariance.item(4) > TUNING.most_horizontal_std_m**2:
                fix = NoFixReason.ACQUIRING
            else:
                return fix
        self.reason = fix
        return None

    def _unwrap(self, packet: Packet) -> _Anchor | None:
        """Unwrap both stamps of a packet; None if it cannot be used."""
        rx_ticks = self._tag_clock.unwrap(packet.rx_ticks, packet.host_s)
        if abs(rx_ticks) > LAST_TICKS:
            self._drops["impossible-host-time"] += 1
            self._tag_clock, self._newest_rx_ticks = Unwrapper(), None
            self._forget()
            return None
        if self._newest_rx_ticks is None:
            fix_time_s(self._time, rx_ticks, rx_ticks)
        elif rx_ticks <= self._newest_rx_ticks and not self._has_new_counter(packet, rx_ticks):
            return None
        self._back_in_row = 0
        position_m = self._position_of(packet)
        anchor = self._anchors.get(packet.anchor)
        if position_m is None or (anchor is None and len(self._anchors) >= MAX_ANCHORS):
            self._drops["unknown-anchor" if position_m is None else "too-many-anchors"] += 1
            self.reason = NoFixReason.NO_ALMANAC
            return None
        if anchor is not None and not anchor.update(packet.tx_ticks, rx_ticks, self._tx_bits):
            self._drops["impossible-stamp"] += 1
            if anchor.impossible < RESTART_IN_ROW:
                return None
            self._drops["clock-restarted"] += 1
            self._delays.forget(packet.anchor)
            anchor = None
        if anchor is None:
            anchor = self._anchors[packet.anchor] = _Anchor(position_m, packet.tx_ticks, rx_ticks)
            self._update_area()
        elif anchor.position_m != position_m:
            anchor.position_m, anchor.anchor_m = position_m, np.array(position_m)
            self._update_area()
        self._newest_rx_ticks = rx_ticks
        remember(anchor.heard, packet.sequence, anchor.tx_ticks, rx_ticks)
        return anchor

    def _has_new_counter(self, packet: Packet, rx_ticks: int) -> bool:
        """Whether a packet from before the newest one means that the tag's counter has restarted."""
        anchor = self._anchors.get(packet.anchor)
        known = None if anchor is None else anchor.heard.get(packet.sequence)
        if known is not None and known[1] == rx_ticks:
            self._drops["duplicate"] += 1
            return False
        self._drops["out-of-order"] += 1
        self._back_in_row += 1
        if self._back_in_row < BACK_IN_ROW:
            return False
        self._forget()
        return True

    def _forget(self) -> None:
        """Forget all stamps, as the tag's counter has restarted."""
        self._anchors.clear()
        self._watch.forget()

    def _position_of(self, packet: Packet) -> Point | None:
        """The sender's position: as surveyed, else as stated in this or an earlier packet."""
        known = self._positions_m.get(packet.anchor)
        stated_m = None if packet.anchor in self._surveyed else packet.position_m
        if stated_m is None or (known is None and len(self._positions_m) >= MAX_ANCHORS):
            return known
        self._positions_m[packet.anchor] = stated_m
        return stated_m

    def _update_area(self) -> None:
        self._area_m = neighbourhood_m(np.array([anchor.position_m for anchor in self._anchors.values()]))

    def _relayed(self, listener: int, anchor: _Anchor, relay: Relay) -> int | str:
        """The anchor's reception of another's packet, unwrapped and without antenna delays, or why there is none."""
        sender = self._anchors.get(relay.anchor)
        heard = None if sender is None else sender.heard.get(relay.sequence)
        if heard is None or sender is anchor:
            return "relay-of-unheard-packet"
        tx_ticks, rx_ticks_tag = heard
        age = anchor.rx_ticks - rx_ticks_tag
        if age > RELAY_MAX_AGE_S * TICK_RATE_HZ:
            return "relay-too-old"
        rx_ticks = nearest(relay.rx_ticks, anchor.tx_ticks - age, self._tx_bits)
        delay = self._delays.ticks(listener, relay.anchor, tx_ticks, rx_ticks, relay.tof_ticks)
        return "time-of-flight-unknown" if delay is None else rx_ticks - delay

    def _calibrated(self, name: int, anchor: _Anchor) -> int:
        """The tag's stamp of an anchor's newest packet without the calibrated bias."""
        assert self._calibration is not None
        known = self._calibration.anchors.get(name, NO_BIAS)
        bias_m = known.bias_m
        if known.slope_m and self.position_m is not None:
            bias_m += known.slope_m * log(max(dist(self.position_m, anchor.position_m), SLOPE_NEAREST_M))
        return anchor.rx_ticks - round(bias_m / TICK_M)

    def _count_relays(self) -> None:
        """Update the sum of relays rejected by filters, whose counter starts from zero with each start."""
        rejected = self.tracking.estimator.state.status.relays_rejected
        if rejected < self._rejected_now:
            self._rejected_before += self._rejected_now
        self._rejected_now = rejected


def _phase_of(received: Packet | Relay) -> float:
    """The carrier phase for the filter; negative if unknown."""
    return -1.0 if received.carrier_phase_cycles is None else received.carrier_phase_cycles
