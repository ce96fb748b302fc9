"""How a tag on a board works, to the byte: kept in its flash, and sent over the serial link.

The board's end is ``firmware/source/settings.c``, with the same names; a test compares both.
"""

import struct
from binascii import crc_hqx
from math import inf
from typing import Final

from msgspec import Struct
from msgspec.structs import astuple

from skyless.core.ticks import DEFAULT_ANTENNA_DELAY_TICKS

VERSION: Final = 1
MODES: Final = ("radio", "tag")
"""A radio for its host, or a tag that computes its own position; settings have their place here."""
OUTPUTS: Final = ("records", "nmea", "json", "none")
"""What a tag says on its serial port."""
ANY_SITE: Final = 0xFFFF

_WORDS: Final = struct.Struct("<11I2i3I3f")
SETTINGS_BYTES: Final = _WORDS.size + 2
"""Words and CRC."""


class BoardSettings(Struct, frozen=True):
    """Settings in the board's own units; the defaults are those of a new one."""

    mode: int = 0
    output: int = 0
    rate_hz: int = 10
    """How often it says something, at most; 0 for each fix."""
    baud: int = 1_000_000
    bluetooth_ms: int = 0
    """Interval of the Bluetooth advertisements; 0 for none."""
    site: int = ANY_SITE
    tag: int = 1
    tx_delay_ticks: int = DEFAULT_ANTENNA_DELAY_TICKS
    rx_delay_ticks: int = DEFAULT_ANTENNA_DELAY_TICKS
    has_bounds: int = 0
    low_mm: int = 0
    high_mm: int = 0
    sleep_ms: int = 0
    """How long it sleeps between two fixes; 0 for always on."""
    superframes: int = 3
    """How many it listens to after each sleep."""
    predicts: int = 0
    """1 where its receiver is on only when beacons are due."""
    qa_m2ps3: float = 0.3
    integrity_risk: float = 1e-4
    alert_limit_m: float = 0.0
    """0 for none."""


def pack(settings: BoardSettings) -> bytes:
    """The bytes of settings; words that do not fit raise struct.error."""
    words = _WORDS.pack(VERSION, *astuple(settings))
    return words + crc_hqx(words, 0xFFFF).to_bytes(2, "big")


def unpack(data: bytes) -> BoardSettings | None:
    """The settings of these bytes; None for what no board of this version has sent."""
    if len(data) != SETTINGS_BYTES or crc_hqx(data, 0xFFFF) != 0:
        return None
    version, *words = _WORDS.unpack_from(data)
    made = BoardSettings(*words[:-3], *(float(f"{single:.7g}") for single in words[-3:]))
    is_known = version == VERSION and made.mode < len(MODES) and made.output < len(OUTPUTS)
    return made if is_known and 0.0 < made.integrity_risk <= 0.1 and 0.0 <= made.alert_limit_m < inf else None
