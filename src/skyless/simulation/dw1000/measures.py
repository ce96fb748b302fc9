"""What the chip measures, as its registers hold it, from what the emulated air tells.

The formulas are those of UM 4.7.1, 4.7.2, 7.2.22, 7.2.40.11 and 7.2.43.2 (DW1000 User Manual v2.12), turned around.
"""

import math
from typing import Final

from msgspec import Struct

from skyless.air.reception import Diagnostics

PRF_64_DB: Final = 121.74
"""The constant of both powers at 64 MHz PRF (UM 4.7.1, 4.7.2)."""

SYMBOLS: Final = 118
"""Symbols that are accumulated of a preamble of 128: assumed; some go by until it is detected."""

HZ_PER_STEP: Final = 998.4e6 / 2 / 1024 / 131072
"""Of the carrier integrator (UM 7.2.40.11), at 850 kbit/s and above."""
CHANNEL_HZ: Final = 6489.6e6
TRACKING_INTERVAL: Final = 0x01FC0000
"""RX_TTCKI at 64 MHz PRF (UM p. 98)."""

TEMPERATURE_STEP_C: Final = 1.14
REFERENCE_C: Final = 23.0
VOLT_STEPS: Final = 173.0
REFERENCE_V: Final = 3.3
"""UM pp. 158-159; the readings at these references are in the OTP."""

_GREATEST: Final = 0xFFFF


class Measured(Struct, frozen=True):
    """Diagnostics of a frame as register values."""

    symbols: int
    first_path: tuple[int, int, int]
    cir_power: int
    carrier: int
    """21 bits, two's complement."""
    tracking: int
    """19 bits, two's complement."""


def measure(told: Diagnostics) -> Measured:
    """Register values; zeros stand for what the air does not tell."""
    symbols, cir_power = _cir_power(told.rx_power_dbm)
    offset = 1e-6 * (told.carrier_offset_ppm or 0.0)
    carrier = round(-offset * CHANNEL_HZ / HZ_PER_STEP)  # UM p. 151: the minus comes from how it is measured
    tracking = round(offset * TRACKING_INTERVAL)
    first_path = _first_path(told.first_path_power_dbm, symbols)
    return Measured(symbols, first_path, cir_power, _signed(carrier, 21), _signed(tracking, 19))


def _cir_power(power_dbm: float | None) -> tuple[int, int]:
    """RXPACC and CIR_PWR with power = 10 log10(CIR_PWR · 2^17 / RXPACC²) - A.

    Where CIR_PWR would overflow fewer symbols are accumulated: a stand-in for the gain control.
    """
    if power_dbm is None:
        return SYMBOLS, 0
    ratio = 10.0 ** ((power_dbm + PRF_64_DB) / 10.0) / 2.0**17
    symbols = min(SYMBOLS, max(int(math.sqrt(_GREATEST / ratio)), 8))
    return symbols, min(round(ratio * symbols * symbols), _GREATEST)


def _first_path(power_dbm: float | None, symbols: int) -> tuple[int, int, int]:
    """FP_AMPL1 to 3 with power = 10 log10((F1² + F2² + F3²) / RXPACC²) - A; the middle one the greatest."""
    if power_dbm is None:
        return 0, 0, 0
    total = 10.0 ** ((power_dbm + PRF_64_DB) / 10.0) * symbols * symbols
    one, two = (min(round(math.sqrt(share * total)), _GREATEST) for share in (0.3, 0.4))
    three = math.sqrt(max(total - one * one - two * two, 0.0))
    return one, two, min(round(three), _GREATEST)


def _signed(value: int, bits: int) -> int:
    """Two's complement, held at the ends."""
    half = 1 << (bits - 1)
    return min(max(value, -half), half - 1) & ((1 << bits) - 1)


class Senses(Struct, frozen=True):
    """Temperature and supply of a chip, and what was measured of it when it was made."""

    temperature_c: float = 31.0
    supply_v: float = 3.3
    reading_at_23_c: int = 0x7E
    reading_at_3_3_v: int = 0x6C
    crystal_trim: int = 0x11
    part: int = 0x10205EAD

    def readings(self) -> tuple[int, int]:
        """SAR_LVBAT and SAR_LTEMP."""
        volts = round((self.supply_v - REFERENCE_V) * VOLT_STEPS) + self.reading_at_3_3_v
        kelvins = round((self.temperature_c - REFERENCE_C) / TEMPERATURE_STEP_C) + self.reading_at_23_c
        return min(max(volts, 0), 255), min(max(kelvins, 0), 255)

    def otp(self) -> dict[int, int]:
        """Words of the one-time programmable memory that are not 0 (UM 6.3.1)."""
        return {
            0x006: self.part,
            0x007: 0x4C4F5431,
            0x008: self.reading_at_3_3_v | 0xB0 << 8,
            0x009: self.reading_at_23_c | 0x8E << 8,
            0x01E: self.crystal_trim,
        }
