"""Time as the radio counts it: 40-bit counters of 15.65 ps ticks, unwrapped to integers.

Ticks are subtracted as integers and only then turned into seconds or metres (``docs/maths.md`` section 3):
float64 seconds lose 0.6 mm after an hour, integers lose nothing.
"""

from typing import Annotated, Final

from msgspec import Meta, Struct

from skyless.core.constants import MAX_DRIFT, TICK_BITS, TICK_RATE_HZ, TICK_S

WRAP_TICKS: Final = 1 << TICK_BITS
HALF_WRAP_TICKS: Final = WRAP_TICKS // 2
TICK_MASK: Final = WRAP_TICKS - 1

LAST_TICKS: Final = 1 << 61
"""A year of ticks, whose differences fit 64 bits; a host's clock that jumps by more was set."""


def wrap(ticks: int, bits: int = TICK_BITS) -> int:
    """Return an unwrapped time as the counter of that many bits shows it, in [0, 2**bits)."""
    return ticks & ((1 << bits) - 1)


def difference(later: int, earlier: int, bits: int = TICK_BITS) -> int:
    """Signed ``later - earlier`` of two counter values, in [-2**(bits-1), 2**(bits-1)).

    Right whenever the true difference is shorter than half a wrap, 8.6 s for 40 bits.
    """
    half = 1 << (bits - 1)
    return ((later - earlier + half) & ((half << 1) - 1)) - half


def nearest(counter: int, expected_ticks: int, bits: int = TICK_BITS) -> int:
    """The unwrapped time that the counter shows and that lies nearest to the expected one."""
    half = 1 << (bits - 1)
    return expected_ticks + ((counter - expected_ticks + half) & ((half << 1) - 1)) - half


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


def may_elapse(counter_ticks: int, elapsed_ticks: int, slack_ticks: float) -> bool:
    """Whether one crystal's counter may go by ``counter_ticks`` while another's goes by ``elapsed_ticks``."""
    return abs(counter_ticks - elapsed_ticks) <= MAX_DRIFT * elapsed_ticks + slack_ticks


def continued(counter: int, last_ticks: int, elapsed_ticks: int, bits: int = TICK_BITS) -> int | None:
    """Unwrapped stamp of a counter ``elapsed_ticks`` after its last one; None if no crystal went from that to this."""
    ticks = nearest(counter, last_ticks + elapsed_ticks, bits)
    return ticks if may_elapse(ticks - last_ticks, elapsed_ticks, NOISE_TICKS) else None


class Unwrapper(Struct):
    """Turns one counter's wrapped stamps into int64 ticks that never wrap.

    Without a host time a stamp is assumed to lie within half a wrap (8.6 s for 40 bits) of the stamp before it,
    before or after. With one, the host's clock decides which wrap it is, however long the gap, as long as the
    host's clock errs by less than half a wrap over that gap. Stamps with and without a host time may alternate.
    """

    bits: Annotated[int, Meta(ge=1, le=64)] = TICK_BITS
    last_ticks: int | None = None
    last_host_s: float | None = None

    def unwrap(self, counter: int, host_s: float | None = None) -> int:
        """Unwrapped ticks of a counter value; the first stamp keeps its own value.

        A stamp out of order is placed where it belongs, before the ones already seen.
        """
        last, last_host_s, half_wrap = self.last_ticks, self.last_host_s, 1 << (self.bits - 1)
        if last is None:
            ticks = counter
        else:
            least = last - half_wrap
            if host_s is not None and last_host_s is not None:
                least += round((host_s - last_host_s) * TICK_RATE_HZ)
            ticks = least + ((counter - least) & ((half_wrap << 1) - 1))
            if host_s is None and last_host_s is not None:
                host_s = last_host_s + to_seconds(ticks - last)
        self.last_ticks, self.last_host_s = ticks, host_s
        return ticks

    def expect(self, counter: int) -> int:
        """Unwrapped ticks of a counter value near the last stamp; it does not count as a stamp."""
        return counter if self.last_ticks is None else nearest(counter, self.last_ticks, self.bits)


class FixTime(Struct):
    """Counts from the first fix of a receiver and never goes back, even if the master or the method changes."""

    first_ticks_master: int | None = None
    last_ticks_master: int = 0
    last_rx_ticks_tag: int = 0

    def time_s(self, ticks_master: int, rx_ticks_tag: int) -> float:
        """Time in seconds of a fix that holds at this master time, given the tag's reading for it, both unwrapped."""
        if self.first_ticks_master is None:
            self.first_ticks_master = ticks_master
        else:
            elapsed, gone = rx_ticks_tag - self.last_rx_ticks_tag, ticks_master - self.last_ticks_master
            if elapsed <= 0 or not may_elapse(gone, elapsed, FLIGHT_SLACK_TICKS):
                self.first_ticks_master += gone - max(elapsed, 1)
        self.last_ticks_master, self.last_rx_ticks_tag = ticks_master, rx_ticks_tag
        return (ticks_master - self.first_ticks_master) * TICK_S
