"""A frame that comes in, as the chip's registers show it (DW1000 User Manual v2.12, sections 4.1, 7.2.18 to 7.2.23)."""

from typing import Final, Literal

from skyless.air.airtime import PREAMBLE_SYMBOL_S
from skyless.air.fcs import is_intact
from skyless.air.reception import Diagnostics
from skyless.simulation.dw1000 import bits
from skyless.simulation.dw1000 import registers as r
from skyless.simulation.dw1000.measures import SYMBOLS, TRACKING_INTERVAL, Measured, measure
from skyless.simulation.dw1000.memory import Memory
from skyless.simulation.dw1000.settings import why_deaf
from skyless.simulation.dw1000.transceiver import DX_MASK, PREAMBLE_TICKS, Transceiver
from skyless.ticks import difference, from_seconds, wrap

Fault = Literal["header", "parity", "delimiter", "first-path"]
FAULT_EVENTS: Final[dict[Fault, int]] = {
    "header": bits.RXPRD | bits.RXSFDD | bits.RXPHE,
    "parity": bits.RXPRD | bits.RXSFDD | bits.RXPHD | bits.RXRFSL,
    "delimiter": bits.RXPRD | bits.RXSFDTO,
    "first-path": bits.RXPRD | bits.RXSFDD | bits.RXPHD | bits.RXDFR | bits.RXFCG | bits.LDEERR,
}
"""What SYS_STATUS shows of a frame that is spoilt: in its header, its data, before its delimiter, or its stamp."""

NEEDED_SYMBOLS: Final = 64
"""Of the preamble's 128, for a receiver that is turned on while a frame comes in (assumed)."""
_MISSABLE_TICKS: Final = from_seconds((128 - NEEDED_SYMBOLS) * PREAMBLE_SYMBOL_S)

SFD_COUNTED: Final = 5
"""Symbols of the delimiter that RXPACC counts where it equals RXPACC_NOSAT, for the standard one (UM table 18)."""

SUSPECT_TICKS: Final = 1024
"""How wrong the stamp is after an error without a reset of the receiver (assumed; UM 4.1.6 tells that it may be)."""


def arrive(
    memory: Memory,
    transceiver: Transceiver,
    frame: bytes,
    antenna_ticks: int,
    told: Diagnostics,
    *,
    microcode: bool,
    fault: Fault | None = None,
) -> str:
    """Let a frame come in whose RMARKER was at the antenna at that reading of the counter; what became of it.

    ``antenna_ticks`` counts the antenna delay in, as the chip's own stamp does before LDE_RXANTD is taken off.
    """
    reason = _why_unheard(memory, transceiver, antenna_ticks)
    if reason is not None:
        return reason
    if fault in ("header", "parity", "delimiter"):
        _end(memory, transceiver, FAULT_EVENTS[fault], is_error=True)
        return "spoilt"
    events = FAULT_EVENTS["first-path"] & ~(bits.LDEERR | bits.RXFCG)
    is_good = is_intact(frame)
    stamped = bool(memory.get(r.PMSC_CTRL1) & bits.LDERUNE)
    _fill(memory, frame, measure(told))
    memory.put(r.RX_RAWST, antenna_ticks & DX_MASK)
    if stamped and not microcode:
        _end(memory, transceiver, events, is_error=False)  # neither good nor bad: it waits for ever for the stamp
        return "without-microcode"
    events |= bits.RXFCG if is_good else bits.RXFCE
    if stamped:
        wrong = SUSPECT_TICKS if transceiver.suspect else 0
        memory.put(r.RX_STAMP, wrap(antenna_ticks - memory.get(r.LDE_RXANTD) + wrong))
        events |= bits.LDEERR if fault == "first-path" else bits.LDEDONE
    _end(memory, transceiver, events, is_error=not is_good)
    if fault == "first-path" or not is_good:
        return "spoilt"
    return "suspect" if transceiver.suspect else "heard"


def _why_unheard(memory: Memory, transceiver: Transceiver, antenna_ticks: int) -> str | None:
    since = transceiver.listening_since
    if since is None:
        return "receiver-off"
    if difference(wrap(antenna_ticks - PREAMBLE_TICKS + _MISSABLE_TICKS), since) < 0:
        return "preamble-missed"
    return None if why_deaf(memory) is None else "deaf"


def _end(memory: Memory, transceiver: Transceiver, events: int, *, is_error: bool) -> None:
    """The receiver turns itself off, but after an error with RXAUTR (UM 7.2.6)."""
    if is_error:
        transceiver.suspect = True
    if not (is_error and memory.get(r.SYS_CFG) & bits.RXAUTR):
        transceiver.listening_since = None
    transceiver.raise_bits(events)


def _fill(memory: Memory, frame: bytes, measured: Measured) -> None:
    """RX_FINFO, the frame, and what was measured of it."""
    length_and_kind = (
        len(frame) | 0b01 << 11 | 0b10 << 13 | 1 << 15 | 0b10 << 16 | 0b01 << 18
    )  # 128 symbols, 6.8 Mbit/s
    whole = measured.symbols == SYMBOLS  # then symbols of the delimiter were counted, too (UM 7.2.18, table 18)
    counted = measured.symbols + (SFD_COUNTED if whole else 0)
    memory.put(r.RX_FINFO, length_and_kind | counted << 20)
    memory.put(r.RXPACC_NOSAT, counted if whole else SYMBOLS)
    memory.fill(r.RX_BUFFER, frame)
    for register, value in zip((r.FP_AMPL1, r.FP_AMPL2, r.FP_AMPL3), measured.first_path, strict=True):
        memory.put(register, value)
    memory.put(r.CIR_PWR, measured.cir_power)
    memory.put(r.STD_NOISE, 40)
    memory.put(r.FP_INDEX, 745 << 6)
    memory.put(r.DRX_CAR_INT, measured.carrier)
    memory.put(r.RX_TTCKI, TRACKING_INTERVAL)
    memory.put(r.RX_TTCKO, measured.tracking)
