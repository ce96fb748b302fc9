"""``joint`` as a positioning method: cold start, message by message updates, and starting again when lost."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyless.constants import TICK_S
from skyless.positioning.acquisition import MAX_AGE_S, SPEED_STD_MPS, Start
from skyless.positioning.fix import Fix, NoFixReason
from skyless.positioning.fix_time import FixTime
from skyless.positioning.in_use import AnchorsInUse
from skyless.positioning.joint import JointFilter
from skyless.positioning.joint_hearing import REJECTED, STALE_PACKET, SYNC_WANTED
from skyless.positioning.joint_report import (
    clock_of,
    is_contradicted,
    is_doubtful,
    is_lost,
    places_excluded,
    relays_fit,
)
from skyless.positioning.joint_settings import JointSettings
from skyless.positioning.joint_start import JointStart
from skyless.positioning.master_scale import MasterScale
from skyless.positioning.observation import Observation
from skyless.positioning.protection import IntegrityRequirement
from skyless.positioning.tracking import (
    HASTE,
    MAX_GAP_S,
    MAX_SPEED_STD_MPS,
    MAX_SPREAD,
    SHORT_SILENCE_S,
    SLOW_S,
    SLOW_SPREAD,
    SOON_S,
)
from skyless.ticks import from_seconds

LOOSENED: Final = 4.0
"""The start's covariance is taken so many times larger, as the filter is then given the packets that it rests on."""

CAUTION_M2: Final = 1.0
"""Variance that the first receptions have beyond their noise after a start that failed at once: many may be late."""

REORDERED_S: Final = 0.1
"""Packets that are older than the newest by less are late from the radio or the host; others mean another counter."""

SURELY_IN_REACH_TICKS: Final = from_seconds(SHORT_SILENCE_S) - 1
"""After such a silence a filter need not be asked."""

NOT_USED: Final = frozenset({REJECTED, STALE_PACKET})

NOBODY: Final = -1

NOTHING: Final[list[int]] = []


class JointTracking:
    """One tag's joint filter from the first beacon on."""

    def __init__(
        self,
        settings: JointSettings,
        z_bounds_m: tuple[float, float] | None = None,
        fix_time: FixTime | None = None,
        superframe_s: float = 0.0,
    ) -> None:
        """``fix_time``: the receiver's, where it outlives this method; ``superframe_s``: of slow sites."""
        self._settings = settings
        self._height_known = settings.height_m is not None
        self._asked = IntegrityRequirement(settings.integrity_risk, settings.alert_limit_m)
        self._superframe_s = superframe_s
        self._max_spread = MAX_SPREAD if superframe_s < SLOW_S else SLOW_SPREAD
        self._z_bounds_m = z_bounds_m
        self._speed_std_mps = SPEED_STD_MPS
        self._filter = JointFilter(settings, np.empty((0, 3)))
        self._place_of: dict[int, int] = {}
        self._known_m: dict[int, NDArray[np.float64]] = {}
        self._start: JointStart | None = self._new_start()
        self._time = fix_time or FixTime()
        self._in_use = AnchorsInUse(superframe_s)
        self._master_less_tag_ticks = 0
        self._started_ticks = 0
        self._caution_m2 = 0.0
        self._heard_ticks = 0
        self._master_scale = MasterScale()
        self._believes_relays = True

    @property
    def filter(self) -> JointFilter:
        """The filter with all its states."""
        return self._filter

    def clock(self, anchor: int) -> tuple[int, float, float] | None:
        """The tag's clock less that of an anchor in view: whole ticks, the rest in metres, rate in m/s."""
        place = self._place_of.get(anchor)
        joint = self._filter
        return None if place is None else clock_of(joint.arrays, joint.dim, place)

    @property
    def excluded(self) -> tuple[int, ...]:
        """Anchors that are not used as they have been wrong for long."""
        places = set(places_excluded(self._filter.arrays))
        return tuple(anchor for anchor, place in self._place_of.items() if place in places) if places else ()

    def hear(self, observation: Observation) -> Fix | NoFixReason:
        """Take one observation; a fix for every accepted message once started."""
        ticks_master, rx_ticks, claim = observation.tx_ticks_master, observation.rx_ticks_tag, observation.claim
        if ticks_master is not None:
            self._master_less_tag_ticks = ticks_master - rx_ticks
            if claim is not None and claim.master == observation.anchor:
                self._master_scale.hear(observation)
        if (
            self._start is None
            and not 0 <= rx_ticks - self._heard_ticks < SURELY_IN_REACH_TICKS
            and self._is_out_of_reach(observation)
        ):
            self._start = self._new_start()
        if self._start is not None:
            self._start.learn(observation)
            start = self._start.hear(observation)
            if isinstance(start, NoFixReason):
                return start
            self._begin(start, self._start.packets())
            return self._fix(observation)
        status = self._take(observation)
        self._heard_ticks = max(self._heard_ticks, rx_ticks)
        if status in NOT_USED:
            self._start_anew_where_lost(rx_ticks)
            return NoFixReason.RESIDUALS
        if not self._believes_relays:
            self._believes_relays = relays_fit(self._filter.arrays)
        elif is_contradicted(self._filter.arrays):
            self._believes_relays = False  # if a new start does not help, the anchors are wrong, not the place
            self._start = self._new_start()
            return NoFixReason.ACQUIRING
        self._in_use.use(observation)
        return self._fix(observation)

    def coast(self, observation: Observation) -> Fix | NoFixReason:
        """A fix when a packet came that was not used itself: by all others, and by what was relayed with it."""
        return NoFixReason.RESIDUALS if self._start is not None else self._fix(observation)

    def _start_anew_where_lost(self, rx_ticks: int) -> None:
        """A filter that is lost soon after its start has a tag that is faster than assumed, or late messages."""
        soon = (rx_ticks - self._started_ticks) * TICK_S < SOON_S
        doubtful = soon and self._caution_m2 == 0.0 and is_doubtful(self._filter.arrays)
        if doubtful or is_lost(self._filter.arrays):
            hasten = soon and not doubtful
            self._speed_std_mps = min(HASTE * self._speed_std_mps, MAX_SPEED_STD_MPS) if hasten else SPEED_STD_MPS
            self._caution_m2 = CAUTION_M2 if soon else 0.0
            self._start = self._new_start()

    def _new_start(self) -> JointStart:
        settings = self._settings
        max_age_s = max(MAX_AGE_S, 2.5 * self._superframe_s)
        variance = settings.tx_variance_m2 + settings.rx_variance_m2
        return JointStart(settings.height_m, variance, self._z_bounds_m, max_age_s, self._speed_std_mps)

    def _is_out_of_reach(self, observation: Observation) -> bool:
        """Whether the filter cannot predict up to here: too long a silence for it, or the tag's counter fell back."""
        silent_s = (observation.rx_ticks_tag - self._heard_ticks) * TICK_S
        if not -REORDERED_S <= silent_s <= MAX_GAP_S:
            return True
        if silent_s < SHORT_SILENCE_S:
            return False
        std_m = self._filter.horizontal_variance_m2(silent_s) ** 0.5
        position_m = self._filter.motion()[0][: self._filter.dim]
        return bool(std_m > self._max_spread * self._in_use.mean_range_m(position_m))

    def _begin(self, start: Start, packets: list[Observation]) -> None:
        """Begin at the start's position, and give the filter the packets that led there."""
        self._start = None
        self._heard_ticks = self._started_ticks = packets[-1].rx_ticks_tag
        self._in_use.begin(start.used)
        dim, begin_ticks = self._filter.dim, packets[0].rx_ticks_tag
        age_s = (start.rx_ticks_tag - begin_ticks) * TICK_S
        covariance = LOOSENED * start.covariance[:dim, :dim] + age_s**2 * start.speed_variance * np.eye(dim)
        self._filter.start(begin_ticks, start.solution[:dim], covariance, start.speed_variance, self._caution_m2)
        for packet in packets:
            self._take(packet)

    def _take(self, observation: Observation) -> int:
        place = self._place(observation)
        claim = observation.claim
        status = self._filter.hear_listed(
            place,
            observation.sequence,
            observation.rx_ticks_tag,
            observation.tx_ticks_anchor,
            self._listed(place, observation) if observation.relays else NOTHING,
            observation.packed_relays,
            NOBODY if claim is None else claim.master,
            0.0 if claim is None else observation.sync_variance_m2,
            observation.rx_variance_factor,
        )
        return self._filter.synchronise(self._sync(observation)) if status >= SYNC_WANTED else status

    def _listed(self, place: int, observation: Observation) -> list[int]:
        """Relays of anchors that are known, as the filter takes them."""
        flat: list[int] = []
        for anchor, sequence, rx_ticks in observation.relays:
            heard = self._place_of.get(anchor)
            if heard is not None:
                flat += (place, heard, sequence, rx_ticks)
        return flat

    def _sync(self, observation: Observation) -> tuple[float, float, float] | None:
        """What the anchor says of its clock against the master's, as the filter takes it."""
        claim, variance_m2 = observation.claim, observation.sync_variance_m2
        if claim is None or variance_m2 <= 0.0:
            return None
        master, difference = self._place_of.get(claim.master), self._master_scale.difference(observation)
        return None if master is None or difference is None else (master, difference, variance_m2)

    def _place(self, observation: Observation) -> int:
        """Place of the packet's anchor in the filter's table."""
        anchor, anchor_m = observation.anchor, observation.anchor_m
        if self._known_m.get(anchor) is not anchor_m:
            place = self._place_of.get(anchor)
            if place is None:
                self._place_of[anchor] = self._filter.add_anchor(anchor_m, anchor)
            else:
                self._filter.move_anchor(place, anchor_m)
            self._known_m[anchor] = anchor_m
        return self._place_of[anchor]

    def _fix(self, observation: Observation) -> Fix | NoFixReason:
        in_use, joint, known = self._in_use, self._filter, self._height_known
        if not known and joint.newest[1][2, 2] > in_use.extent_m**2:
            return NoFixReason.BAD_GEOMETRY
        rx_ticks = observation.rx_ticks_tag
        time_s = self._time.time_s(rx_ticks + self._master_less_tag_ticks, rx_ticks)
        # in the order of the fields: with their names it takes as long as all the rest
        return Fix(time_s, joint.rows.tobytes(), in_use.anchors, in_use.anchors_m, "joint", known, 1, self._asked)
