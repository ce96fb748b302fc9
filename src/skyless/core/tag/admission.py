"""Which frames a tag admits: of the site in use, with stamps that are possible on its sender's and its own counter."""

from typing import Final

from skyless.core.air.anchor_stamps import OUT_OF_ORDER, STAMP_COUNTERS, STAMP_FITS, unwrap_stamp
from skyless.core.air.instants import LONGEST_PERIOD_CODE
from skyless.core.air.neighbours import Neighbours, forget_times
from skyless.core.air.site_choice import (
    CHANGED,
    FOREIGN,
    NO_SITE,
    SiteChoice,
    choose_site,
    restart_choice,
)
from skyless.core.constants import TICK_BITS
from skyless.core.native.records import Record, Ticks, first, record
from skyless.core.native.sizes import MAX_COUNTED, MAX_NEIGHBOURS, MAX_SITES
from skyless.core.ticks import LAST_TICKS, FixTime, Unwrapper, from_seconds, unwrap

COUNTER_JUMP_TICKS: Final = from_seconds(1.0)
"""Two stamps in a row that go back farther than radios and hosts reorder them mean that the tag's own counter has
restarted; a single one is damaged."""

ADMITTED: Final = STAMP_FITS
FOREIGN_SITE, IMPOSSIBLE_HOST_TIME = range(len(STAMP_COUNTERS), len(STAMP_COUNTERS) + 2)
"""What becomes of a frame, beside what its stamp is."""
DROP_COUNTERS: Final = (*STAMP_COUNTERS, ("foreign-site",), ("impossible-host-time",))
"""By what each is counted."""

COUNTER_JUMPED, HOST_JUMPED, SITE_CHANGED = 1, 2, 4
"""What has happened: the tag's counter has restarted, its host's clock was set, or it uses another site."""


@record
class Admission(Record):
    """What a tag knows of its own counter, of sites and of anchors."""

    own: Unwrapper
    former: Unwrapper
    """``own`` before the frame at hand, restored where that is not admitted."""
    went_back: bool
    """Whether the stamp of the newest frame is from before others by more than ``COUNTER_JUMP_TICKS``."""
    choice: SiteChoice
    time: FixTime
    neighbours: Neighbours
    rx_ticks: Ticks
    """The tag's stamp of the frame at hand, unwrapped."""
    events: int
    """What has happened since its owner last looked."""


def admit_sender(a: Admission, site: int, anchor: int, rx_counter: Ticks, host_s: float) -> int:
    """Unwrap the tag's stamp of a frame, and find out whether its site is in use; ``ADMITTED`` or why not.

    ``host_s``: the host's time of it, NaN where that is not known.
    """
    a.former = a.own
    a.rx_ticks = unwrap(a.own, rx_counter, host_s)
    t, went_back = a.neighbours, a.went_back
    is_possible = -LAST_TICKS <= a.rx_ticks <= LAST_TICKS
    a.went_back = t.has_newest and a.rx_ticks < t.newest_rx_ticks - COUNTER_JUMP_TICKS
    if is_possible and a.went_back and not went_back:
        a.own = a.former
        return OUT_OF_ORDER
    if not is_possible or a.went_back:
        a.went_back = False
        forget_times(t)
        a.events |= COUNTER_JUMPED if is_possible else HOST_JUMPED
        restart_choice(a.choice, a.rx_ticks if is_possible else 0)
        if not is_possible:
            a.own.has_stamp = False
            return IMPOSSIBLE_HOST_TIME
    had_site = a.choice.site != NO_SITE
    use = choose_site(a.choice, site, anchor, a.rx_ticks)
    if use == FOREIGN:
        return FOREIGN_SITE
    if use == CHANGED and had_site:
        t.count, t.has_newest = 0, False
        a.events |= SITE_CHANGED
    return ADMITTED


def admit_stamp(a: Admission, anchor: int, sequence: int, tx_counter: Ticks, period_ticks: Ticks) -> int:
    """Unwrap the TX stamp of a frame of the site in use; ``ADMITTED`` or why it is not used."""
    stamp = unwrap_stamp(a.neighbours, anchor, sequence, tx_counter, a.rx_ticks, period_ticks)
    if stamp == STAMP_FITS:
        a.choice.heard_ticks = a.rx_ticks
    else:
        a.own = a.former
    return stamp


def check(a: Admission) -> None:
    """Check what compiled functions use as indices, in a record that may come from anywhere.

    Raises:
        ValueError: one is beyond its table.
    """
    limits = [
        ("anchors", a.neighbours.count, MAX_NEIGHBOURS),
        ("rows", a.neighbours.row + 1, MAX_NEIGHBOURS),
        ("sites", a.choice.count, MAX_SITES),
        ("failed sites", a.choice.failed_count, MAX_SITES),
        *(("bits other than a radio's", abs(one.bits - TICK_BITS), 0) for one in (a.own, a.former)),
        *(("anchors of a site", one.count, MAX_COUNTED) for one in first(a.choice.sites, MAX_SITES)),
        *(
            ("as a period's code", one.period_code, LONGEST_PERIOD_CODE)
            for one in first(a.neighbours.rows, MAX_NEIGHBOURS)
        ),
    ]
    for name, number, most in limits:
        if not 0 <= number <= most:
            raise ValueError(f"the receiver's state has {number} {name}; it can have up to {most}")
