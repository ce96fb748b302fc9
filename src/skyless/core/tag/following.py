"""A tag from its first packet on: search for a start, filtering, and starting again when the tag is lost.

The filter's state and the search are never used at the same time, so a board may keep both in the same memory
(``SHARES_MEMORY``): a new filter starts from copies of the search's results.
"""

from typing import Annotated, Final

from skyless.core.estimator.faults import (
    fits_settings,
    horizontal_variance_m2,
    is_late_often,
    is_lost,
    relays_contradict,
    relays_fit,
)
from skyless.core.estimator.levels import largest_test
from skyless.core.estimator.process import REJECTED, STALE, Packet, Place, Relays, process, process_frame, take_relays
from skyless.core.estimator.settings import TUNING, EstimatorSettings, Tuning
from skyless.core.estimator.state import AXES, State, at, restart
from skyless.core.fix import POSITION, PROTECTED_ROWS, PROTECTION, QUALITY, VELOCITY
from skyless.core.integrity import STATE, UNAVAILABLE
from skyless.core.native.arithmetic import sqrt, square
from skyless.core.native.records import MAX_ANCHORS, Array, Bytes, Count, Matrix, Reals, Record, Ticks, record
from skyless.core.tag.acquisition import (
    ACQUIRING,
    TOO_FEW_ANCHORS,
    Acquisition,
    HeardPacket,
    Start,
    forget_all,
    try_start,
)
from skyless.core.tag.position import FOUND, IMPOSSIBLE, MIRROR, RESIDUALS, UNSETTLED
from skyless.core.tag.search import LARGEST
from skyless.core.ticks import TICK_S, FixTime, fix_time_ticks, from_seconds

# A tag with a filter: the outcome of each packet, and when the tag must start again.

FIX, OUTLIER, LOST, START_CONTRADICTED, BAD_GEOMETRY = range(20, 25)
"""Outcomes of a packet. After ``LOST`` and ``START_CONTRADICTED`` the tag must start again."""

SURELY_IN_REACH_TICKS: Final = from_seconds(TUNING.short_silence_s) - 1
"""After silences up to this the filter predicts without a check."""


NOBODY: Final = -1
"""Stands for no anchor."""


@record
class UsedAnchor(Record):
    """An anchor whose packets were accepted recently."""

    anchor: int
    position_m: Annotated[Reals, AXES]
    rx_ticks: Ticks
    """Tag time of its last accepted packet."""


@record
class Course(Record):
    """The history of the tag's starts, and the anchors in use."""

    settings: EstimatorSettings
    """Settings of the next filter, as are the next four fields."""
    tuning: Tuning
    dim: int
    horizontal_k: float
    vertical_k: float
    superframe_s: float
    """Superframe of slow sites, otherwise 0."""
    most_anchors: int
    """A filter starts with at most this many anchors: those of the start, nearest first. 0: with all."""
    is_starting: bool = True
    """Whether there is no position yet. While True the search is in use, otherwise the filter's state."""
    late_share: float
    """Share of late packets that the last filter estimated."""
    misfit: int = NOBODY
    """The anchor that was inconsistent with the others at the start."""
    alone: Annotated[Matrix, PROTECTED_ROWS, AXES]
    """Rows of a fix that comes from a start alone, without a filter."""
    open_range_errors: bool
    """Whether the next start expects larger range errors than the settings state."""
    is_open: bool
    """Whether the last start did so."""
    start_was_contradicted: bool
    relays_may_contradict: bool = True
    may_begin_again: bool = True
    """Whether a start with a poor fit may be abandoned: not twice in a row."""
    heights_rejected: int
    started_ticks: Ticks
    newest_ticks: Ticks
    in_use_s: float
    """An anchor counts as in use while its last accepted packet is younger than this."""
    checked_ticks: Ticks
    """Tag time of the last such check."""
    extent_m: float
    """Largest span of the anchors in use along x, y or z since the start."""
    changes: Count
    """Number of changes of the anchors in use or of their positions."""
    count: int
    used: Annotated[Array[UsedAnchor], MAX_ANCHORS]
    time_ticks: Ticks
    """Time of the newest fix, counted from the first one."""


def process_in_course(
    c: Course, s: State, time: FixTime, packet: Packet, relays: Relays, packed: Bytes, packed_bytes: int
) -> int:
    """Process a packet by ``process_frame`` while the tag has a filter. Returns the outcome."""
    outcome = process_frame(s, packet, relays, packed, packed_bytes)
    c.newest_ticks = max(c.newest_ticks, packet.rx_ticks)
    if outcome in (REJECTED, STALE):
        return LOST if is_lost(s) else OUTLIER
    if _judge_start(c, s, packet.rx_ticks):
        return START_CONTRADICTED
    use_anchor(c, packet.place, packet.rx_ticks)
    return settle(c, s, time, packet.rx_ticks)


def settle(c: Course, s: State, time: FixTime, rx_ticks: Ticks) -> int:
    """Return FIX or BAD_GEOMETRY: a 3-D fix needs a height standard deviation within the extent of the anchors."""
    if s.dim == AXES and s.P[at(2, 2)] > square(c.extent_m):
        return BAD_GEOMETRY
    c.time_ticks = fix_time_ticks(time, rx_ticks, rx_ticks)
    return FIX


def is_surely_in_reach(c: Course, rx_ticks: Ticks) -> bool:
    """Whether the last packet is recent enough for the filter to predict without a check."""
    return 0 <= rx_ticks - c.newest_ticks < SURELY_IN_REACH_TICKS


def _judge_start(c: Course, s: State, rx_ticks: Ticks) -> bool:
    """Return True if relays or faults contradict the start, so that a new one is needed.

    Also records what the new start has to expect.
    """
    tuning = s.tuning
    if c.start_was_contradicted and is_late_often(s):
        c.open_range_errors = c.start_was_contradicted = False  # caused by single late packets
        return True
    age_s = (rx_ticks - c.started_ticks) * TICK_S
    if age_s >= tuning.new_start_s:
        c.may_begin_again = True
    elif c.may_begin_again and s.fix[QUALITY][0] > tuning.wrong_nis:
        c.may_begin_again = False  # if a new start does not help, everything is noisier than stated
        return True
    if c.is_open and age_s > tuning.new_start_s and fits_settings(s):
        c.open_range_errors = False
        return True
    limit = tuning.sure_chi2 if c.start_was_contradicted else tuning.uncovered_chi2
    if largest_test(s) > limit and (not c.is_open or age_s > tuning.new_start_s):
        c.open_range_errors = not is_late_often(s)
        return True
    if not c.relays_may_contradict:
        c.relays_may_contradict = relays_fit(s)
    elif relays_contradict(s):
        c.relays_may_contradict = False  # if a new start does not help, the anchors are wrong, not the position
        return True
    return False


# Anchors in use


def use_anchor(c: Course, place: Place, rx_ticks: Ticks) -> None:
    """Record an accepted packet of an anchor, and drop the anchors that have been silent for too long."""
    index = 0
    while index < c.count and c.used[index].anchor != place.anchor:
        index += 1
    is_new = index == c.count
    if is_new and c.count == MAX_ANCHORS:
        index = _longest_silent(c)
    c.count = max(c.count, index + 1)
    used, has_changed = c.used[index], is_new
    for axis in range(AXES):
        has_changed = has_changed or used.position_m[axis] != place.position_m[axis]
        used.position_m[axis] = place.position_m[axis]
    used.anchor, used.rx_ticks = place.anchor, rx_ticks
    if (rx_ticks - c.checked_ticks) * TICK_S > c.in_use_s:
        c.checked_ticks = rx_ticks
        before = c.count
        _forget_silent(c, rx_ticks)
        has_changed = has_changed or c.count < before
    if has_changed:
        c.changes += 1
        for axis in range(AXES):
            _widen(c, axis)


def _longest_silent(c: Course) -> int:
    oldest = 0
    for index in range(c.count):
        if c.used[index].rx_ticks < c.used[oldest].rx_ticks:
            oldest = index
    return oldest


def _forget_silent(c: Course, rx_ticks: Ticks) -> None:
    kept = 0
    for index in range(c.count):
        if (rx_ticks - c.used[index].rx_ticks) * TICK_S <= c.in_use_s:
            if kept < index:
                c.used[kept] = c.used[index]
            kept += 1
    c.count = kept


def _widen(c: Course, axis: int) -> None:
    """Include the anchors' span along an axis in ``extent_m``."""
    lowest = highest = c.used[0].position_m[axis]
    for index in range(1, c.count):
        lowest = min(lowest, c.used[index].position_m[axis])
        highest = max(highest, c.used[index].position_m[axis])
    c.extent_m = max(c.extent_m, highest - lowest)


START_FIX, SEARCHING, HAS_TOO_FEW, IS_MIRRORED, IS_UNSETTLED = range(25, 30)
"""Further outcomes: a fix from a start alone (``Course.alone``), or why there is no start yet."""

MAX_BEGINNING: Final = 2 * MAX_ANCHORS


@record
class Beginning(Record):
    """What a filter starts from."""

    start: Start
    count: int
    packets: Annotated[Array[HeardPacket], MAX_BEGINNING]
    """In order of reception."""


def begin_course(c: Course, q: Acquisition) -> None:
    """Search for a start with the settings in ``c``, keeping the packets gathered so far."""
    c.in_use_s = max(c.tuning.short_silence_s, 1.5 * c.superframe_s)
    c.open_range_errors = c.is_open = c.start_was_contradicted = False
    c.relays_may_contradict = c.may_begin_again = True
    c.heights_rejected = c.count = 0
    c.started_ticks = c.newest_ticks = c.checked_ticks = 0
    c.late_share = c.extent_m = 0.0
    c.misfit = NOBODY
    c.changes += 1
    _begin_search(c, q)


def begin_again(c: Course, s: State, q: Acquisition) -> None:
    """Abandon the filter and search again. Only the share of late packets is kept."""
    c.late_share = s.status.late_share
    _begin_search(c, q)


def _begin_search(c: Course, q: Acquisition) -> None:
    """Set up the search. It keeps its packets only if no filter has run in between."""
    settings, tuning = c.settings, c.tuning
    if not c.is_starting:
        forget_all(q)
    c.is_starting = True
    q.tuning = tuning
    q.knows_height, q.height_m = c.dim < AXES, settings.height_m if c.dim < AXES else 0.0
    q.has_bounds = settings.lowest_m > -LARGEST or settings.highest_m < LARGEST
    q.low_m, q.high_m = settings.lowest_m, settings.highest_m
    q.variance_m2 = settings.tx_variance_m2 + settings.rx_variance_m2
    q.max_age_s = max(tuning.start_age_s, 2.5 * c.superframe_s)
    q.start_age_s = max(tuning.start_age_s, c.superframe_s)
    q.speed_std_mps = settings.start_speed_std_mps
    q.error_variance_m2 = square(settings.range_std_m) + square(settings.survey_std_m)
    q.rival_count = 0
    q.has_been_wide = q.is_contradicted = False


def follow(
    c: Course, s: State, q: Acquisition, time: FixTime, packet: Packet, relays: Relays, packed: Bytes, packed_bytes: int
) -> int:
    """Process a packet whose further relays are still encoded (``packed``). Returns the outcome."""
    rx_ticks = packet.rx_ticks
    if not c.is_starting and not is_surely_in_reach(c, rx_ticks) and _is_out_of_reach(c, s, rx_ticks):
        begin_again(c, s, q)
    if not c.is_starting:
        outcome = process_in_course(c, s, time, packet, relays, packed, packed_bytes)
        if outcome in (LOST, START_CONTRADICTED):
            begin_again(c, s, q)
        return outcome
    take_relays(packet, relays, packed, packed_bytes)
    found = try_start(q, packet, relays)
    if found != FOUND:
        return _outcome_of(found)
    if q.start.is_contradicted and not q.start.has_misfit and _was_late_often(c):
        return OUTLIER  # single packets are late; the next ones will not be
    if c.superframe_s > c.tuning.longest_superframe_s:
        _fill_alone(c, q)
        c.time_ticks = fix_time_ticks(time, rx_ticks, rx_ticks)
        return START_FIX
    return settle(c, s, time, rx_ticks) if _begin_filter(c, s, q, relays) else SEARCHING


def _outcome_of(found: int) -> int:
    if found in (RESIDUALS, IMPOSSIBLE):
        return OUTLIER
    if found == TOO_FEW_ANCHORS:
        return HAS_TOO_FEW
    if found == MIRROR:
        return IS_MIRRORED
    if found == UNSETTLED:
        return IS_UNSETTLED
    return SEARCHING if found == ACQUIRING else BAD_GEOMETRY


def _was_late_often(c: Course) -> bool:
    return c.late_share > c.tuning.late_often_share


# Whether the filter can continue


def _is_out_of_reach(c: Course, s: State, rx_ticks: Ticks) -> bool:
    """Whether the filter cannot predict to this time: the silence is too long, or the tag's counter went back."""
    tuning, silent_s = c.tuning, (rx_ticks - c.newest_ticks) * TICK_S
    if silent_s < -tuning.short_silence_s or silent_s > tuning.longest_silence_s:
        return True
    if silent_s < tuning.short_silence_s:
        return False
    part = tuning.curved_std if c.superframe_s < tuning.slow_superframe_s else tuning.slow_curved_std
    return sqrt(horizontal_variance_m2(s, silent_s)) > part * _mean_range_m(c, s.x)


def _mean_range_m(c: Course, position_m: Reals) -> float:
    """Mean distance from a position to the anchors in use."""
    total_m = 0.0
    for index in range(c.count):
        total_m += _distance_m(c, c.used[index].position_m, position_m)
    return total_m / max(c.count, 1)


def _distance_m(c: Course, one_m: Reals, other_m: Reals) -> float:
    """Distance between two points; horizontal only if the height is given."""
    total = 0.0
    for axis in range(c.dim):
        total += square(one_m[axis] - other_m[axis])
    return sqrt(total)


# From a start to a filter


def _use_only(c: Course, q: Acquisition) -> None:
    """Make the anchors of the start the only ones in use."""
    c.count, c.extent_m = 0, 0.0
    for index in range(q.start.count):
        newest = q.heard[q.start.used[index]].newer.packet
        use_anchor(c, newest.place, newest.rx_ticks)


def _fill_alone(c: Course, q: Acquisition) -> None:
    """Write a fix from the start alone: position, assumed speed, no protection level."""
    _use_only(c, q)
    for row in range(PROTECTED_ROWS):
        for axis in range(AXES):
            c.alone[row][axis] = 0.0
    for axis in range(c.dim):
        c.alone[POSITION][axis] = q.start.position_m[axis]
        for other in range(c.dim):
            c.alone[POSITION + 1 + axis][other] = q.start.covariance_m2[axis][other]
        c.alone[VELOCITY + 1 + axis][axis] = square(c.settings.start_speed_std_mps)
    if c.dim < AXES:
        c.alone[POSITION][2] = c.settings.height_m
    c.alone[PROTECTION][STATE] = UNAVAILABLE


def _begin_filter(c: Course, s: State, q: Acquisition, relays: Relays) -> bool:
    """Start the filter at the start's position and process the packets behind it.

    Returns False if late anchors may have shifted the start by more than their distance; the start is useless then.
    """
    b = Beginning()
    b.start = q.start
    start, tuning = b.start, c.tuning
    _choose_packets(c, q, b)
    is_contradicted = start.is_contradicted and not _was_late_often(c)
    is_open = c.open_range_errors or (is_contradicted and not start.has_misfit)
    inflation = tuning.start_margin
    if is_open or is_contradicted:
        inflation = 1.0 + square(tuning.late_std_m) / (q.variance_m2 + q.error_variance_m2)
    begin_ticks, speed_m2ps2 = b.packets[0].packet.rx_ticks, square(c.settings.start_speed_std_mps)
    moved_m2 = square((start.rx_ticks_tag - begin_ticks) * TICK_S) * speed_m2ps2
    _use_only(c, q)
    horizontal_m2 = inflation * (start.covariance_m2[0][0] + start.covariance_m2[1][1]) + 2.0 * moved_m2
    part = tuning.slow_start_std if c.superframe_s > tuning.slow_superframe_s else 1.0
    if horizontal_m2 > square(part * _mean_range_m(c, start.position_m)):
        return False
    c.is_starting = False
    c.newest_ticks = c.started_ticks = b.packets[b.count - 1].packet.rx_ticks
    c.is_open, c.start_was_contradicted = is_open, is_open or is_contradicted
    c.misfit = start.misfit if is_contradicted and start.has_misfit else NOBODY
    s.settings, s.tuning = c.settings, tuning
    s.dim, s.horizontal_k, s.vertical_k = c.dim, c.horizontal_k, c.vertical_k
    restart(
        s, begin_ticks, c.late_share, tuning.late_std_m if c.start_was_contradicted else tuning.lasting_std_m, is_open
    )
    for axis in range(c.dim):
        s.x[axis] = start.position_m[axis]
        for other in range(c.dim):
            s.P[at(axis, other)] = inflation * start.covariance_m2[axis][other] + (moved_m2 if axis == other else 0.0)
        s.P[at(c.dim + axis, c.dim + axis)] = speed_m2ps2
    for index in range(b.count):
        one = b.packets[index]
        one.packet.place.is_open = one.packet.place.anchor == c.misfit
        relays.count = one.relay_count
        for relayed in range(one.relay_count):
            relays.rows[relayed] = one.relays[relayed]
        process(s, one.packet, relays)
    return True


def _choose_packets(c: Course, q: Acquisition, b: Beginning) -> None:
    """Choose the packets of each anchor that the filter starts with.

    The start's residuals belong to each anchor's newer packet. If earlier packets were inconsistent and these are not,
    an older one may be late, so its variance is increased where relays determine the anchor's clock too.
    """
    factor = 1.0
    if q.is_contradicted and not q.start.is_contradicted:
        factor += square(c.tuning.lasting_std_m) / c.settings.rx_variance_m2
    for place in range(q.count):
        if _is_chosen(c, q, place):
            _insert_packet(b, q.heard[place].newer, 1.0)
    for place in range(q.count):
        if q.heard[place].count > 1 and _is_chosen(c, q, place):
            _insert_packet(b, q.heard[place].older, factor)


def _insert_packet(b: Beginning, one: HeardPacket, factor: float) -> None:
    """Insert a packet in order of reception; ``factor`` scales its variance."""
    place = b.count
    while place > 0 and b.packets[place - 1].packet.rx_ticks > one.packet.rx_ticks:
        b.packets[place] = b.packets[place - 1]
        place -= 1
    b.packets[place] = one
    b.packets[place].packet.variance_factor *= factor
    b.count += 1


def _is_chosen(c: Course, q: Acquisition, place: int) -> bool:
    """Whether the filter starts with the anchor at index ``place`` of ``heard``."""
    start = q.start
    is_slow = c.superframe_s > c.tuning.slow_superframe_s  # the start is from the anchors of half a second only
    if c.most_anchors == 0 or (is_slow and q.count <= c.most_anchors):
        return True
    if start.has_misfit and q.heard[place].newer.packet.place.anchor == start.misfit:
        return True
    own_m = _distance_m(c, q.heard[place].newer.packet.place.position_m, start.position_m)
    is_used, nearer = False, 0
    for index in range(start.count):
        range_m = _distance_m(c, q.heard[start.used[index]].newer.packet.place.position_m, start.position_m)
        if start.used[index] == place:
            is_used = True
        elif range_m < own_m or (range_m == own_m and not is_used):
            nearer += 1
    return is_used and nearer < c.most_anchors
