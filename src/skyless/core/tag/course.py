"""A tag that knows where it is: what becomes of a packet, and when it has to begin again (``following.py``)."""

from typing import Annotated, Final

from skyless.core.constants import TICK_S
from skyless.core.estimator.levels import largest_test
from skyless.core.estimator.process import REJECTED, STALE, Packet, Place, Relays, process_frame
from skyless.core.estimator.settings import TUNING, EstimatorSettings, Tuning
from skyless.core.estimator.state import AXES, State, at
from skyless.core.estimator.verdicts import fits_settings, is_late_often, is_lost, relays_contradict, relays_fit
from skyless.core.fix import PROTECTED_ROWS, QUALITY
from skyless.core.native.arithmetic import square
from skyless.core.native.records import Array, Bytes, Count, Matrix, Reals, Record, Ticks, record
from skyless.core.native.sizes import MAX_ANCHORS
from skyless.core.ticks import FixTime, fix_time_ticks, from_seconds

FIX, OUTLIER, LOST, START_CONTRADICTED, BAD_GEOMETRY = range(20, 25)
"""What becomes of a packet. After ``LOST`` and ``START_CONTRADICTED`` the tag has to begin again."""

SURELY_IN_REACH_TICKS: Final = from_seconds(TUNING.short_silence_s) - 1
"""Silences up to this need no check of the filter."""


NOBODY: Final = -1
"""The identifier of no anchor."""


@record
class UsedAnchor(Record):
    """An anchor in use."""

    anchor: int
    position_m: Annotated[Reals, AXES]
    rx_ticks: Ticks
    """The tag's stamp of its last accepted packet."""


@record
class Course(Record):
    """What has become of the starts so far, and whose packets were accepted recently."""

    settings: EstimatorSettings
    """Those with which a filter begins, as the next four."""
    tuning: Tuning
    dim: int
    horizontal_k: float
    vertical_k: float
    superframe_s: float
    """Of slow sites, else 0."""
    most_anchors: int
    """With which a filter begins, the nearest, and none that does not belong to the start; 0: with all."""
    is_starting: bool = True
    """Whether no position is known; else the search is not used, now the state is not."""
    late_share: float
    """That of the last filter."""
    misfit: int = NOBODY
    """The anchor that contradicted the others at the start."""
    alone: Annotated[Matrix, PROTECTED_ROWS, AXES]
    """What a fix carries that is a start's, without a filter."""
    open_range_errors: bool
    """Whether the next start expects larger range errors than the settings state."""
    is_open: bool
    """Whether the last start did."""
    start_was_contradicted: bool
    relays_may_contradict: bool = True
    may_begin_again: bool = True
    """Whether a start that fits badly from the beginning is given up: not twice in a row."""
    heights_rejected: int
    master_less_tag_ticks: Ticks
    started_ticks: Ticks
    newest_ticks: Ticks
    in_use_s: float
    """An anchor counts as in use while its last accepted packet is younger than this."""
    checked_ticks: Ticks
    """When that was checked last."""
    extent_m: float
    """The largest span in x, y or z that anchors in use have had since the start."""
    changes: Count
    """How often the anchors in use, or their positions, have changed."""
    count: int
    used: Annotated[Array[UsedAnchor], MAX_ANCHORS]
    time_ticks: Ticks
    """Of the newest fix, since the first one."""


def process_in_course(
    c: Course, s: State, time: FixTime, packet: Packet, relays: Relays, packed: Bytes, packed_bytes: int
) -> int:
    """Process a packet of a tag that knows where it is, as ``process_frame``; what becomes of it."""
    outcome = process_frame(s, packet, relays, packed, packed_bytes)
    c.newest_ticks = max(c.newest_ticks, packet.rx_ticks)
    if outcome in (REJECTED, STALE):
        return LOST if is_lost(s) else OUTLIER
    if _is_contradicted(c, s, packet.rx_ticks):
        return START_CONTRADICTED
    use_anchor(c, packet.place, packet.rx_ticks)
    return settle(c, s, time, packet.rx_ticks)


def settle(c: Course, s: State, time: FixTime, rx_ticks: Ticks) -> int:
    """Whether the state is a fix: in three dimensions its height may be worse than the anchors' extent."""
    if s.dim == AXES and s.P[at(2, 2)] > square(c.extent_m):
        return BAD_GEOMETRY
    c.time_ticks = fix_time_ticks(time, rx_ticks + c.master_less_tag_ticks, rx_ticks)
    return FIX


def is_surely_in_reach(c: Course, rx_ticks: Ticks) -> bool:
    """Whether the last packet is so recent that the filter can predict from it without a check."""
    return 0 <= rx_ticks - c.newest_ticks < SURELY_IN_REACH_TICKS


def _is_contradicted(c: Course, s: State, rx_ticks: Ticks) -> bool:
    """Whether a new start is needed, as relays or faults contradict this one; decides what that has to expect."""
    tuning = s.tuning
    if c.start_was_contradicted and is_late_often(s):
        c.open_range_errors = c.start_was_contradicted = False  # it was by single late packets
        return True
    age_s = (rx_ticks - c.started_ticks) * TICK_S
    if age_s >= tuning.new_start_s:
        c.may_begin_again = True
    elif c.may_begin_again and s.fix[QUALITY][0] > tuning.wrong_nis:
        c.may_begin_again = False  # if it does not help, all is noisier than stated
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
    """Note that a packet of an anchor was accepted, and forget those that have been silent for too long."""
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
    """Take the anchors' span along an axis into account."""
    lowest = highest = c.used[0].position_m[axis]
    for index in range(1, c.count):
        lowest = min(lowest, c.used[index].position_m[axis])
        highest = max(highest, c.used[index].position_m[axis])
    c.extent_m = max(c.extent_m, highest - lowest)
