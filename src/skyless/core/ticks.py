"""Time as the radio counts it: 40-bit counters of 15.65 ps ticks, unwrapped to integers.

Ticks are subtracted as integers and only then turned into seconds or metres (``docs/maths.md`` section 3):
float64 seconds lose 0.6 mm after an hour, integers lose nothing.
"""

from math import nan
from typing import Final

from skyless.core.constants import MAX_DRIFT, TICK_BITS, TICK_RATE_HZ, TICK_S
from skyless.core.native.arithmetic import floor
from skyless.core.native.records import Record, Ticks, record

WRAP_TICKS: Final = 1 << TICK_BITS
TICK_MASK: Final = WRAP_TICKS - 1

LAST_TICKS: Final = 1 << 61
"""A year of ticks, whose differences fit 64 bits; a host's clock that jumps by more was set."""

NEVER: Final = -(1 << 62)
"""Earlier than any reading."""

_LONGEST_JUMP_S: Final = 1e8
"""No jump of a host's clock counts as a longer one: the ticks of three years fit 64 bits."""


def wrap(ticks: int, bits: int = TICK_BITS) -> int:
    """Return an unwrapped time as the counter of that many bits shows it, in [0, 2**bits)."""
    return ticks & ((1 << bits) - 1)


def difference(later: int, earlier: int, bits: int = TICK_BITS) -> int:
    """Signed ``later - earlier`` of two counter values, in [-2**(bits-1), 2**(bits-1)).

    Right whenever the true difference is shorter than half a wrap, 8.6 s for 40 bits.
    """
    half = 1 << (bits - 1)
    return ((later - earlier + half) & ((half << 1) - 1)) - half


def nearest(counter: Ticks, expected_ticks: Ticks, bits: int = TICK_BITS) -> Ticks:
    """The unwrapped time that the counter shows and that lies nearest to the expected one."""
    half: Ticks = 1
    half = half << (bits - 1)
    return expected_ticks - half + ((counter - expected_ticks + half) & (2 * half - 1))


def to_seconds(ticks: int) -> float:
    """Seconds of a tick difference; of an epoch far from zero the result keeps only 53 bits."""
    return ticks * TICK_S


def from_seconds(seconds: float) -> int:
    """Nearest whole number of ticks."""
    return round(seconds * TICK_RATE_HZ)


FLIGHT_SLACK_TICKS: Final = round(1e-6 * TICK_RATE_HZ)
"""Flight times differ between anchors by less than this (300 m)."""

NOISE_TICKS: Final = 64
"""0.3 m allow for the noise of two stamps of one anchor."""


def may_elapse(counter_ticks: Ticks, elapsed_ticks: Ticks, slack_ticks: float) -> bool:
    """Whether one crystal's counter may go by ``counter_ticks`` while another's goes by ``elapsed_ticks``."""
    return abs(counter_ticks - elapsed_ticks) <= MAX_DRIFT * elapsed_ticks + slack_ticks


def continued(counter: int, last_ticks: int, elapsed_ticks: int, bits: int = TICK_BITS) -> int | None:
    """Unwrapped stamp of a counter ``elapsed_ticks`` after its last one; None if no crystal went from that to this."""
    ticks = nearest(counter, last_ticks + elapsed_ticks, bits)
    return ticks if may_elapse(ticks - last_ticks, elapsed_ticks, NOISE_TICKS) else None


@record
class Unwrapper(Record):
    """Turns one counter's wrapped stamps into int64 ticks that never wrap (``unwrap``)."""

    bits: int = TICK_BITS
    """Width of the counter, 62 at most."""
    has_stamp: bool
    last_ticks: Ticks
    last_host_s: float = nan
    """NaN where no stamp has had a host time."""

    def unwrap(self, counter: int, host_s: float | None = None) -> int:
        """Unwrapped ticks of a counter value, as ``unwrap``."""
        return unwrap(self, counter, nan if host_s is None else host_s)

    def expect(self, counter: int) -> int:
        """Unwrapped ticks of a counter value near the last stamp; it does not count as a stamp."""
        return nearest(counter, self.last_ticks, self.bits) if self.has_stamp else counter


def unwrap(u: Unwrapper, counter: Ticks, host_s: float) -> Ticks:
    """Unwrapped ticks of a counter value; the first stamp keeps its own value.

    Without a host time, NaN, a stamp is assumed to lie within half a wrap (8.6 s for 40 bits) of the stamp before it,
    before or after. With one, the host's clock decides which wrap it is, however long the gap, as long as the host's
    clock errs by less than half a wrap over that gap. Stamps with and without a host time may alternate. A stamp out of
    order is placed where it belongs, before the ones already seen.
    """
    ticks = counter
    if u.has_stamp:
        expected_ticks, elapsed_s = u.last_ticks, host_s - u.last_host_s
        if abs(elapsed_s) >= 0.0:  # it is a number
            elapsed_s = max(min(elapsed_s, _LONGEST_JUMP_S), -_LONGEST_JUMP_S)
            expected_ticks += floor(elapsed_s * TICK_RATE_HZ + 0.5)
        ticks = nearest(counter, expected_ticks, u.bits)
        if not abs(host_s) >= 0.0:
            host_s = u.last_host_s + (ticks - u.last_ticks) * TICK_S
    u.has_stamp, u.last_ticks, u.last_host_s = True, ticks, host_s
    return ticks


@record
class FixTime(Record):
    """Counts from the first fix of a receiver and never goes back, even if the master or the method changes."""

    has_fix: bool
    first_ticks_master: Ticks
    last_ticks_master: Ticks
    last_rx_ticks_tag: Ticks


def fix_time_s(time: FixTime, ticks_master: int, rx_ticks_tag: int) -> float:
    """``fix_time_ticks`` in seconds."""
    return to_seconds(fix_time_ticks(time, ticks_master, rx_ticks_tag))


def fix_time_ticks(time: FixTime, ticks_master: Ticks, rx_ticks_tag: Ticks) -> Ticks:
    """Time of a fix that holds at this master time, given the tag's reading for it, both unwrapped."""
    if not time.has_fix:
        time.has_fix, time.first_ticks_master = True, ticks_master
    else:
        elapsed, gone = rx_ticks_tag - time.last_rx_ticks_tag, ticks_master - time.last_ticks_master
        if elapsed <= 0 or not may_elapse(gone, elapsed, FLIGHT_SLACK_TICKS):
            time.first_ticks_master += gone - max(elapsed, 1)
    time.last_ticks_master, time.last_rx_ticks_tag = ticks_master, rx_ticks_tag
    return ticks_master - time.first_ticks_master
