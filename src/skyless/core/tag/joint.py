"""``joint``: the estimator as a positioning method: cold start, packet by packet updates, new starts when lost."""

from math import sqrt
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array
from skyless.core.constants import TICK_S
from skyless.core.estimator.compiled import process_frame
from skyless.core.estimator.estimator import NO_REPORT, Estimator, Report, SavedEstimator
from skyless.core.estimator.process import ACCEPTED, MAX_RELAYS, Packet
from skyless.core.estimator.settings import TUNING, EstimatorSettings
from skyless.core.fix import POSITION, PROTECTED_ROWS, PROTECTION, VELOCITY, Fix, NoFixReason
from skyless.core.integrity import UNAVAILABLE, IntegrityRequirement
from skyless.core.native.library import compiled
from skyless.core.native.records import first, packed, unpacked
from skyless.core.native.sizes import MAX_ANCHORS
from skyless.core.native.views import view
from skyless.core.observation import Observation
from skyless.core.tag.acquisition import (
    ACQUIRING,
    MAX_LINKS,
    TOO_FEW_ANCHORS,
    Acquisition,
    HeardPacket,
    forget_packets,
    try_start,
)
from skyless.core.tag.course import (
    BAD_GEOMETRY,
    FIX,
    LOST,
    OUTLIER,
    START_CONTRADICTED,
    Course,
    is_surely_in_reach,
    process_in_course,
    settle,
    use_anchor,
)
from skyless.core.tag.position import FOUND, IMPOSSIBLE, MIRROR, RESIDUALS, UNSETTLED
from skyless.core.ticks import FixTime, fix_time_s


class EstimationState(Struct, frozen=True, tag="joint"):
    """All that an ``Estimation`` keeps."""

    estimator: SavedEstimator
    start: bytes | None
    course: bytes


class Estimation:
    """One tag's estimator from the first beacon on."""

    def __init__(
        self,
        settings: EstimatorSettings,
        z_bounds_m: tuple[float, float] | None = None,
        fix_time: FixTime | None = None,
        superframe_s: float = 0.0,
        most_anchors: int | None = None,
    ) -> None:
        """``fix_time``: the receiver's, where it outlives this method; ``superframe_s``: of slow sites.

        ``most_anchors``: with which to begin, the nearest, and none that does not belong to the start; None: with all.
        """
        if z_bounds_m is not None:
            settings = settings.changed(lowest_m=z_bounds_m[0], highest_m=z_bounds_m[1])
        self._settings = settings
        self._height_m = settings.known_height_m
        self._height_known = settings.dim == 2
        self._requirement = IntegrityRequirement(
            settings.integrity_risk, settings.alert_limit, settings.max_acceleration_mps2, settings.height_std_m
        )
        self._superframe_s = superframe_s
        self._most_anchors = most_anchors
        self._max_relative_std = (
            TUNING.curved_std if superframe_s < TUNING.slow_superframe_s else TUNING.slow_curved_std
        )
        self._z_bounds_m = z_bounds_m
        # one counts as in use while its last accepted message is younger than this
        self.course = Course(in_use_s=max(TUNING.short_silence_s, 1.5 * superframe_s))
        self._estimator = Estimator(settings)
        self._start: Acquisition | None = self._new_start()
        self._time = fix_time or FixTime()
        self._listed = -1
        """The course's changes for which these are the anchors in use."""
        self._anchors: tuple[int, ...] = ()
        self._anchors_m: Array = np.empty((0, 3))

    def state(self) -> EstimationState:
        """All that it keeps, as it is now."""
        start = None if self._start is None else packed(self._start)
        return EstimationState(self._estimator.save(), start, packed(self.course))

    def restore(self, state: EstimationState) -> None:
        """Continue from the state of one with the same settings.

        Raises:
            ValueError: the estimator's arrays are not sound.
        """
        course = unpacked(Course, state.course)
        if not 0 <= course.count <= MAX_ANCHORS:
            raise ValueError(f"{course.count} anchors are in use; there can be {MAX_ANCHORS}")
        self._start = None if state.start is None else _restored_start(state.start, self._new_start())
        self._estimator.restore(state.estimator)
        self.course, self._listed = course, -1

    @property
    def estimator(self) -> Estimator:
        """The filter with all its states."""
        return self._estimator

    def remove_anchor(self, anchor: int) -> int:
        """Use nothing more of what was received of an anchor; how many others remain, if a position is known."""
        self._estimator.remove_anchor(anchor)
        if self._start is None:
            return len(self._estimator.anchors)
        forget_packets(self._start, anchor)
        return 0

    @property
    def is_starting(self) -> bool:
        """Whether no position is known yet."""
        return self._start is not None

    def clock(self, anchor: int) -> tuple[int, float, float] | None:
        """The tag's clock less that of an anchor in the state: whole ticks, the rest in metres, rate in m/s."""
        return self._estimator.clock(anchor)

    @property
    def excluded(self) -> tuple[int, ...]:
        """Anchors whose range error has jumped and not come back."""
        return self._estimator.obstructed

    def update(self, observation: Observation) -> Fix | NoFixReason:
        """Process one observation; a fix for every accepted packet once started."""
        ticks_master, rx_ticks = observation.tx_ticks_master, observation.rx_ticks_tag
        if ticks_master is not None:
            self.course.master_less_tag_ticks = ticks_master - rx_ticks
        is_near = is_surely_in_reach(self.course, rx_ticks)
        if self._start is None and not is_near and self._is_out_of_reach(observation):
            self._start = self._new_start()
        if self._start is not None:
            return self._try_start(self._start, observation)
        packet, relays = self._packet(observation), observation.packed_relays
        estimator = self._estimator
        return self.result_of(_process_in_course(self.course, estimator.state, self._time, packet, relays, len(relays)))

    def result_of(self, outcome: int) -> Fix | NoFixReason:
        """What the outcome of a packet in the course means; the next one may be a start."""
        if outcome == FIX:
            return self.fix()
        if outcome in {LOST, START_CONTRADICTED}:
            self._start = self._new_start()
        return _REASONS[outcome]

    def fix(self) -> Fix:
        """The fix of the packet that was processed last."""
        course, requirement = self.course, self._requirement
        if course.changes != self._listed:
            self._list_anchors()
        rows, anchors, anchors_m = self._estimator.rows, self._anchors, self._anchors_m
        # in the order of the fields: with their names it takes as long as all the rest
        return Fix(course.time_s, rows, anchors, anchors_m, "joint", self._height_known, 1, requirement)

    def _list_anchors(self) -> None:
        used = view(self.course.used)[: self.course.count]
        self._anchors, self._anchors_m = tuple(used["anchor"].tolist()), used["position_m"].copy()
        self._listed = self.course.changes

    def _try_start(self, starting: Acquisition, observation: Observation) -> Fix | NoFixReason:
        given, relays = HeardPacket(packet=self._packet(observation)), observation.packed_relays
        if observation.tx_ticks_master is not None:
            given.is_stated, given.stated.ticks = True, observation.tx_ticks_master
            given.stated.fraction_ticks = observation.tx_fraction_ticks
            given.stated.variance_m2 = observation.tx_variance_m2
        reason = _try_to_start(starting, given, relays, len(relays))
        if reason != FOUND:
            return _NO_START.get(reason, NoFixReason.BAD_GEOMETRY)
        start = starting.start
        if start.is_contradicted and not start.has_misfit and self._estimator.is_late_often:
            return NoFixReason.RESIDUALS  # single packets are late: others will not be
        if self._superframe_s > TUNING.longest_superframe_s:
            return self._fix_of(starting, observation)
        return self._settled(observation) if self._begin(starting) else NoFixReason.ACQUIRING

    def update_height(self, height_m: float, std_m: float) -> bool:
        """Process the tag's height as a sensor measures it, at the newest packet; True if it was used.

        Before a start it bounds the heights of the search. Where many in a row do not fit, the start was wrong.
        """
        if self._start is not None:
            margin_m = TUNING.height_sigmas * std_m
            self._start.has_bounds = True
            self._start.low_m, self._start.high_m = height_m - margin_m, height_m + margin_m
            return False
        used = self._estimator.process_height(height_m, std_m) == ACCEPTED
        self.course.heights_rejected = 0 if used else self.course.heights_rejected + 1
        if self.course.heights_rejected >= TUNING.heights_in_row and not self._height_known:
            self.course.heights_rejected = 0
            self._start = self._new_start()
        return used

    def coast(self, observation: Observation) -> Fix | NoFixReason:
        """A fix when a packet came that was not used itself: by all others, and by what was relayed with it."""
        return NoFixReason.RESIDUALS if self._start is not None else self._settled(observation)

    def _settled(self, observation: Observation) -> Fix | NoFixReason:
        """The state as a fix, if it is one."""
        return self.result_of(settle(self.course, self._estimator.state, self._time, observation.rx_ticks_tag))

    def _new_start(self) -> Acquisition:
        settings, bounds_m = self._settings, self._z_bounds_m
        low_m, high_m = (0.0, 0.0) if bounds_m is None else bounds_m
        return Acquisition(
            knows_height=self._height_known,
            height_m=0.0 if self._height_m is None else self._height_m,
            has_bounds=bounds_m is not None,
            low_m=low_m,
            high_m=high_m,
            variance_m2=settings.tx_variance_m2 + settings.rx_variance_m2,
            max_age_s=max(TUNING.start_age_s, 2.5 * self._superframe_s),
            speed_std_mps=settings.start_speed_std_mps,
            error_variance_m2=_error_variance_m2(settings),
            tuning=TUNING,
        )

    def _is_out_of_reach(self, observation: Observation) -> bool:
        """Whether the filter cannot predict up to here: too long a silence for it, or the tag's counter fell back."""
        silent_s = (observation.rx_ticks_tag - self.course.newest_ticks) * TICK_S
        if not -TUNING.short_silence_s <= silent_s <= TUNING.longest_silence_s:
            return True
        if silent_s < TUNING.short_silence_s:
            return False
        std_m = sqrt(self._estimator.horizontal_variance_m2(silent_s))
        return std_m > self._max_relative_std * self._mean_range_m(self._estimator.position_m())

    def _mean_range_m(self, position_m: Array) -> float:
        """From a position, shape (2,) or (3,), to the anchors in use."""
        self._list_anchors()
        away = self._anchors_m[:, : len(position_m)] - position_m
        return float(np.linalg.norm(away, axis=1).mean())

    def _use_only(self, starting: Acquisition) -> None:
        """Use the anchors of a start and no others."""
        self.course.count, self.course.extent_m = 0, 0.0
        for place in first(starting.start.used, starting.start.count):
            newest = starting.heard[place].newer.packet
            use_anchor(self.course, newest.place, newest.rx_ticks)

    def _begin(self, starting: Acquisition) -> bool:
        """Begin at the start's position, and process the packets that led there.

        False where anchors that are late may have moved it by more than their distance: it says nothing then.
        """
        settings, dim, start = self._settings, self._estimator.dim, starting.start
        packets = self._packets_of(starting)
        is_contradicted = start.is_contradicted and not self._estimator.is_late_often
        is_open = self.course.open_range_errors or (is_contradicted and not start.has_misfit)
        expected_m2 = settings.tx_variance_m2 + settings.rx_variance_m2 + _error_variance_m2(settings)
        inflation = 1.0 + TUNING.late_std_m**2 / expected_m2 if is_open or is_contradicted else TUNING.start_margin
        begin_ticks, speed_m2ps2 = packets[0].rx_ticks, settings.start_speed_std_mps**2
        age_s = (start.rx_ticks_tag - begin_ticks) * TICK_S
        position_m = view(start.position_m)[:dim].copy()
        covariance = inflation * view(start.covariance_m2)[:dim, :dim] + age_s**2 * speed_m2ps2 * np.eye(dim)
        self._use_only(starting)
        if np.trace(covariance[:2, :2]) > self._mean_range_m(position_m) ** 2:
            return False
        self._start = None
        self.course.newest_ticks = self.course.started_ticks = packets[-1].rx_ticks
        self.course.is_open, self.course.start_was_contradicted = is_open, is_open or is_contradicted
        self._estimator.start(
            begin_ticks,
            position_m,
            covariance,
            speed_m2ps2,
            is_open,
            TUNING.late_std_m if self.course.start_was_contradicted else TUNING.lasting_std_m,
            (start.misfit,) if is_contradicted and start.has_misfit else (),
        )
        for packet in packets:
            packet.place.is_open = packet.place.anchor in self._estimator.misfits
            process_frame(self._estimator.state, packet, b"", 0)
        return True

    def _packets_of(self, starting: Acquisition) -> list[Packet]:
        """The last packets of each anchor with which to begin, in the order of their receptions."""
        heard, start, dim = first(starting.heard, starting.count), starting.start, self._estimator.dim
        if self._most_anchors is not None:
            places = first(start.used, start.count)
            anchors_m = np.array([view(heard[place].newer.packet.place.position_m)[:dim] for place in places])
            away_m = np.linalg.norm(anchors_m - view(start.position_m)[:dim], axis=1)
            nearest = {places[index] for index in np.argsort(away_m, kind="stable")[: self._most_anchors]}
            is_misfit = [start.has_misfit and one.newer.packet.place.anchor == start.misfit for one in heard]
            heard = [one for place, one in enumerate(heard) if place in nearest or is_misfit[place]]
        packets = [one.newer.packet for one in heard] + [one.older.packet for one in heard if one.count > 1]
        return sorted(packets, key=lambda packet: packet.rx_ticks)

    def _packet(self, observation: Observation) -> Packet:
        self._estimator.know_anchor(observation.anchor, observation.anchor_m, observation.anchor_std_m)
        packet = self._estimator.packet_of(
            observation.anchor,
            observation.sequence,
            observation.rx_ticks_tag,
            observation.tx_ticks_anchor,
            observation.relays,
            self._report(observation),
            observation.rx_variance_factor,
            observation.phase_cycles,
            observation.relay_phases,
        )
        packet.relays_have_phases = observation.packed_phases
        return packet

    def _report(self, observation: Observation) -> Report:
        """What the anchor reports of its clock against the master's."""
        if observation.report is None or observation.tx_variance_m2 <= 0.0:
            return NO_REPORT
        return Report(*observation.report, observation.tx_variance_m2)

    def _fix_of(self, starting: Acquisition, observation: Observation) -> Fix:
        """What a start knows by itself: a position, and of the velocity that it is a tag's; no protection level."""
        dim, rows, start = self._estimator.dim, np.zeros((PROTECTED_ROWS, 3)), starting.start
        rows[POSITION, :dim] = view(start.position_m)[:dim]
        if self._height_m is not None:
            rows[POSITION, 2] = self._height_m
        rows[POSITION + 1 : POSITION + 1 + dim, :dim] = view(start.covariance_m2)[:dim, :dim]
        rows[VELOCITY + 1 : VELOCITY + 1 + dim, :dim] = self._settings.start_speed_std_mps**2 * np.eye(dim)
        rows[PROTECTION, 2] = UNAVAILABLE
        self._use_only(starting)
        rx_ticks = observation.rx_ticks_tag
        time_s = fix_time_s(self._time, rx_ticks + self.course.master_less_tag_ticks, rx_ticks)
        self._list_anchors()
        anchors, anchors_m = self._anchors, self._anchors_m
        return Fix(time_s, rows.tobytes(), anchors, anchors_m, "joint", self._height_known, 1, self._requirement)


_REASONS: Final = {
    OUTLIER: NoFixReason.RESIDUALS,
    LOST: NoFixReason.RESIDUALS,
    START_CONTRADICTED: NoFixReason.ACQUIRING,
    BAD_GEOMETRY: NoFixReason.BAD_GEOMETRY,
}

_NO_START: Final = {
    TOO_FEW_ANCHORS: NoFixReason.TOO_FEW_ANCHORS,
    ACQUIRING: NoFixReason.ACQUIRING,
    MIRROR: NoFixReason.MIRROR,
    IMPOSSIBLE: NoFixReason.RESIDUALS,
    RESIDUALS: NoFixReason.RESIDUALS,
    UNSETTLED: NoFixReason.NOT_CONVERGED,
}
"""Other reasons are those of a bad geometry."""

_START_SETTINGS: Final = (
    "knows_height",
    "height_m",
    "variance_m2",
    "max_age_s",
    "speed_std_mps",
    "error_variance_m2",
    "tuning",
)
"""Fields of an acquisition that follow from the settings; bounds of the height may be a sensor's."""

_process_in_course: Final = compiled(process_in_course)
_try_to_start: Final = compiled(try_start)


def _error_variance_m2(settings: EstimatorSettings) -> float:
    """Variance of a range by the errors of anchors and ranges."""
    return settings.range_std_m**2 + settings.survey_std_m**2


def _restored_start(data: bytes, fresh: Acquisition) -> Acquisition:
    """An acquisition from bytes that may come from anywhere: what compiled functions use as an index is checked.

    ``fresh``: one with the settings of this site.

    Raises:
        ValueError: they are no bytes of one, or an index is beyond its table.
    """
    made = unpacked(Acquisition, data)
    for setting in _START_SETTINGS:
        setattr(made, setting, getattr(fresh, setting))
    packets = [one.packet for heard in made.heard for one in (heard.older, heard.newer)]
    counts = [
        (made.count, MAX_ANCHORS),
        (made.link_count, MAX_LINKS),
        *((heard.count, 2) for heard in made.heard),
        *((packet.relay_count, MAX_RELAYS) for packet in packets),
    ]
    if not all(0 <= count <= most for count, most in counts):
        raise ValueError("the start's state has more anchors, links or relays than there can be")
    return made
