"""Time as the radio counts it: 40-bit counters of 15.65 ps ticks, unwrapped to integers.

Ticks are subtracted as integers and only then turned into seconds or metres (``docs/maths.md`` section 3):
float64 seconds lose 0.6 mm after an hour, integers lose nothing.
"""

from math import nan
from typing import Final

from skyless.core.native.arithmetic import floor
from skyless.core.native.records import Record, Ticks, record

# Physical and radio constants, each with its source.

SPEED_OF_LIGHT_MPS: Final = 299_792_458.0
"""Speed of light in vacuum, exact (SI). Air slows it by 0.03 %, 1.6 mm over 6 m, and a calibration absorbs it."""

CHIP_RATE_HZ: Final = 499.2e6
"""Chipping rate of the IEEE 802.15.4 HRP UWB PHY (802.15.4-2015, 16.2)."""

TICK_RATE_HZ: Final = 128 * CHIP_RATE_HZ
"""Rate of the DW1000's timestamp counter, 63.8976 GHz (DW1000 User Manual v2.12, 7.2.8)."""

TICK_S: Final = 1.0 / TICK_RATE_HZ
"""One tick of the timestamp counter, 15.650040064 ps."""

TICK_M: Final = SPEED_OF_LIGHT_MPS * TICK_S
"""Distance that light travels in one tick, 4.692 mm."""

TICK_BITS: Final = 40
"""Width of the timestamp counter (DW1000 User Manual v2.12, 7.2.8); it wraps every 17.2074 s."""

SUBTICKS: Final = 256
"""Subdivisions of a tick: the unit of the site's time on the air, of which beacons carry 48 bits."""

DELAYED_TX_GRANULARITY_TICKS: Final = 512
"""DX_TIME ignores its low nine bits: transmissions start on 8.013 ns boundaries (DW1000 User Manual, p. 26)."""

DEFAULT_ANTENNA_DELAY_TICKS: Final = 16_436
"""Common default of TX_ANTD and LDE_RXANTD at 64 MHz PRF (DW1000 User Manual v2.12, 7.2.25)."""

MAX_DRIFT: Final = 50e-6
"""Largest relative drift of two clocks: 20 ppm each (IEEE 802.15.4-2015, 16.4.9), and room for motion."""

CARRIER_CYCLES: Final = {1: 7, 2: 8, 3: 9, 4: 8, 5: 13, 7: 13}
"""Cycles of each channel's carrier in 128 ticks: the centre frequencies over half the chipping rate (table 16-3)."""

CHANNEL_5_HZ: Final = 6489.6e6
"""Centre frequency of channel 5 (IEEE 802.15.4-2015, table 16-3)."""


WRAP_TICKS: Final = 1 << TICK_BITS
TICK_MASK: Final = WRAP_TICKS - 1

LAST_TICKS: Final = 1 << 61
"""A year of ticks, so that differences fit into 64 bits; a host's clock that jumps by more was set."""

NEVER: Final = -(1 << 62)
"""Earlier than any time."""

_LONGEST_JUMP_S: Final = 1e8
"""Longer jumps of a host's clock are limited to this: the ticks of three years fit into 64 bits."""


def wrap(ticks: int, bits: int = TICK_BITS) -> int:
    """An unwrapped time as a counter of this many bits shows it, in [0, 2**bits)."""
    return ticks & ((1 << bits) - 1)


def difference(later: int, earlier: int, bits: int = TICK_BITS) -> int:
    """Signed ``later - earlier`` of two counter values, in [-2**(bits-1), 2**(bits-1)).

    Correct if the true difference is shorter than half a wrap, 8.6 s for 40 bits.
    """
    half = 1 << (bits - 1)
    return ((later - earlier + half) & ((half << 1) - 1)) - half


def nearest(counter: Ticks, expected_ticks: Ticks, bits: int = TICK_BITS) -> Ticks:
    """The unwrapped time nearest to the expected one that agrees with the counter."""
    half: Ticks = 1
    half = half << (bits - 1)
    return expected_ticks - half + ((counter - expected_ticks + half) & (2 * half - 1))


def to_seconds(ticks: int) -> float:
    """Seconds of a tick difference; far from zero the result keeps only 53 bits."""
    return ticks * TICK_S


def from_seconds(seconds: float) -> int:
    """Nearest whole number of ticks."""
    return round(seconds * TICK_RATE_HZ)


FLIGHT_SLACK_TICKS: Final = round(1e-6 * TICK_RATE_HZ)
"""Largest difference of flight times between anchors (300 m)."""

NOISE_TICKS: Final = 64
"""Allowance of 0.3 m for the noise of two stamps of one anchor."""


def may_elapse(counter_ticks: Ticks, elapsed_ticks: Ticks, slack_ticks: float) -> bool:
    """Whether one crystal's counter may advance by ``counter_ticks`` while another's advances by ``elapsed_ticks``."""
    return abs(counter_ticks - elapsed_ticks) <= MAX_DRIFT * elapsed_ticks + slack_ticks


def continued(counter: int, last_ticks: int, elapsed_ticks: int, bits: int = TICK_BITS) -> int | None:
    """Unwrapped stamp of a counter ``elapsed_ticks`` after its last one; None if no crystal can have got there."""
    ticks = nearest(counter, last_ticks + elapsed_ticks, bits)
    return ticks if may_elapse(ticks - last_ticks, elapsed_ticks, NOISE_TICKS) else None


@record
class Unwrapper(Record):
    """Converts one counter's wrapped stamps to int64 ticks that never wrap (``unwrap``)."""

    bits: int = TICK_BITS
    """Width of the counter, at most 62."""
    has_stamp: bool
    last_ticks: Ticks
    last_host_s: float = nan
    """NaN if no stamp has had a host time."""

    def unwrap(self, counter: int, host_s: float | None = None) -> int:
        """Unwrapped ticks of a counter value, by ``unwrap``."""
        return unwrap(self, counter, nan if host_s is None else host_s)

    def expect(self, counter: int) -> int:
        """Unwrapped ticks of a counter value near the last stamp, without counting it as a stamp."""
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
    """Time of fixes, counted from a receiver's first one; it never goes back, even if master or method change."""

    has_fix: bool
    first_ticks_master: Ticks
    last_ticks_master: Ticks
    last_rx_ticks_tag: Ticks


def fix_time_s(time: FixTime, ticks_master: int, rx_ticks_tag: int) -> float:
    """``fix_time_ticks`` in seconds."""
    return to_seconds(fix_time_ticks(time, ticks_master, rx_ticks_tag))


def fix_time_ticks(time: FixTime, ticks_master: Ticks, rx_ticks_tag: Ticks) -> Ticks:
    """Time of a fix at this master time, given the tag's time of it, both unwrapped."""
    if not time.has_fix:
        time.has_fix, time.first_ticks_master = True, ticks_master
    else:
        elapsed, gone = rx_ticks_tag - time.last_rx_ticks_tag, ticks_master - time.last_ticks_master
        if elapsed <= 0 or not may_elapse(gone, elapsed, FLIGHT_SLACK_TICKS):
            time.first_ticks_master += gone - max(elapsed, 1)
    time.last_ticks_master, time.last_rx_ticks_tag = ticks_master, rx_ticks_tag
    return ticks_master - time.first_ticks_master
