"""The chip's transmitter and receiver (DW1000 User Manual v2.12, sections 3, 4, 7.2.18 to 7.2.23).

Not modelled: double buffering, frame filtering, automatic acknowledgement, sniffing, sleep, long frames, and the
preamble timeout.
"""

import math
from collections import Counter
from typing import Final, Literal, Protocol

from msgspec import Struct

from skyless.air.ieee802154 import (
    HEADER_SYMBOL_S,
    PREAMBLE_SYMBOL_S,
    SFD_SYMBOLS,
    after_rmarker_s,
    fcs,
    is_intact,
    preamble_s,
)
from skyless.air.reception import Diagnostics
from skyless.constants import CHANNEL_5_HZ, CHIP_RATE_HZ, DELAYED_TX_GRANULARITY_TICKS
from skyless.simulation.dw1000 import registers as r
from skyless.simulation.dw1000.memory import Memory
from skyless.simulation.dw1000.settings import can_receive, can_send
from skyless.ticks import difference, from_seconds, wrap

DX_MASK: Final = ~(DELAYED_TX_GRANULARITY_TICKS - 1)
PREAMBLE_TICKS: Final = from_seconds(preamble_s())
_POWER_UP_TICKS: Final = from_seconds(10e-6)
"""What the transmitter needs to power up before the preamble; less gives TXPUTE (assumed: the manual states none)."""
_AT_ONCE_TICKS: Final = from_seconds(0.5e-3)
"""From TXSTRT until a frame without a time leaves: long enough for the emulated air, which must know of it before."""
_TIMEOUT_TICKS: Final = 512 * 128
"""Unit of RX_FWTO and of W4R_TIM: 1.026 µs (UM p. 79)."""
_SFD_TICKS: Final = from_seconds(SFD_SYMBOLS * PREAMBLE_SYMBOL_S)
_HEADER_TICKS: Final = from_seconds(21 * HEADER_SYMBOL_S)

Fault = Literal["header", "parity", "delimiter", "first-path"]
_FAULT_EVENTS: Final[dict[Fault, int]] = {
    "header": r.RXPRD | r.RXSFDD | r.RXPHE,
    "parity": r.RXPRD | r.RXSFDD | r.RXPHD | r.RXRFSL,
    "delimiter": r.RXPRD | r.RXSFDTO,
}
"""What SYS_STATUS shows of a frame that is spoilt in its header, in its data, or before its delimiter."""
_COMPLETE: Final = r.RXPRD | r.RXSFDD | r.RXPHD | r.RXDFR
"""What SYS_STATUS shows of every whole frame."""

_NEEDED_SYMBOLS: Final = 64
"""Of the preamble's 128, for a receiver that is turned on while a frame comes in (assumed)."""
_MISSABLE_TICKS: Final = from_seconds((128 - _NEEDED_SYMBOLS) * PREAMBLE_SYMBOL_S)

_SUSPECT_TICKS: Final = 1024
"""How wrong the stamp is after an error without a reset of the receiver (assumed; UM 4.1.6 states that it may be)."""

PRF_64_DB: Final = 121.74
"""The constant of both powers at 64 MHz PRF (UM 4.7.1, 4.7.2)."""
_ACCUMULATED_SYMBOLS: Final = 118
"""Symbols that are accumulated of a preamble of 128: assumed; some pass before it is detected."""
_SFD_COUNTED: Final = 5
"""Symbols of the delimiter that RXPACC counts where it equals RXPACC_NOSAT, for the standard one (UM table 18)."""
HZ_PER_STEP: Final = CHIP_RATE_HZ / 1024 / 131072
"""Of the carrier integrator (UM 7.2.40.11), at 850 kbit/s and above."""
_TRACKING_INTERVAL: Final = 0x01FC0000
"""RX_TTCKI at 64 MHz PRF (UM p. 98)."""
_GREATEST: Final = 0xFFFF


class Air(Protocol):
    """The medium around the chip's antenna."""

    def now_ticks(self) -> int:
        """The node's 40-bit counter; the chip shows it in steps of 512."""

    def transmit(self, frame: bytes, leaves_ticks: int) -> bool:
        """Let the RMARKER leave the antenna at that reading of the counter; False if it is too late."""

    def withdraw(self) -> None:
        """Cancel what has not been sent."""


class Sending(Struct):
    """A frame that waits or is on its way; ticks without antenna delay."""

    marker_ticks: int
    end_ticks: int
    missed: bool
    """Its time has passed: the chip would send it when the counter comes there again, 17 s later."""
    then_listen: bool


class Transceiver:
    """Transmitter and receiver, of which one works at a time."""

    def __init__(self, memory: Memory, air: Air, tx_delay_ticks: int, misuse: Counter[str]) -> None:
        """``tx_delay_ticks`` is the true delay between the chip and its antenna."""
        self._memory, self._air, self._tx_delay_ticks, self._misuse = memory, air, tx_delay_ticks, misuse
        self.counts: Counter[str] = Counter()
        self.sending: Sending | None = None
        self.listening_since: int | None = None
        self.suspect = False
        """After an error the receiver needs a reset, or the next stamp is wrong (UM 4.1.6)."""

    def reset(self) -> None:
        """Everything off."""
        self._withdraw()
        self.sending, self.listening_since, self.suspect = None, None, False

    # Status

    def raise_bits(self, events: int) -> None:
        """Show events in SYS_STATUS."""
        self._memory.set(r.SYS_STATUS, self._memory.get(r.SYS_STATUS) | events)

    def drop_bits(self, events: int) -> None:
        """Clear events."""
        self._memory.set(r.SYS_STATUS, self._memory.get(r.SYS_STATUS) & ~events)

    # Commands (UM 7.2.15)

    def command(self, control: int) -> None:
        """Obey what was written into SYS_CTRL."""
        if control & r.TRXOFF:
            self.off()
        if control & r.TXSTRT:
            self._start(control)
        elif control & r.RXENAB:
            self._listen(delayed=bool(control & r.RXDLYE))

    def off(self) -> None:
        """TRXOFF: abort whatever is under way; HPDWARN goes with what it warned of (UM p. 91)."""
        self._withdraw()
        self.sending, self.listening_since = None, None
        self.drop_bits(r.HPDWARN)

    def _withdraw(self) -> None:
        if self.sending is not None and not self.sending.missed:
            self._air.withdraw()
            self.counts["withdrawn"] += 1

    def _start(self, control: int) -> None:
        """TXSTRT, with TXDLYS at DX_TIME, whose low nine bits do not count (UM p. 26)."""
        if self.sending is not None or self.listening_since is not None:
            self._misuse["txstrt-while-busy"] += 1
            return
        self.drop_bits(r.OF_SENDING | r.HPDWARN)
        now = self._air.now_ticks()
        delayed = bool(control & r.TXDLYS)
        marker = self._memory.get(r.DX_TIME) if delayed else wrap(now + _AT_ONCE_TICKS)
        marker &= DX_MASK
        frame = self._frame(suppress_fcs=bool(control & r.SFCST))
        ahead = difference(marker, now) - PREAMBLE_TICKS
        missed = ahead < 0
        if not missed and ahead < _POWER_UP_TICKS:
            self.raise_bits(r.TXPUTE)
        if not missed:
            missed = not self._hand_over(frame, wrap(marker + self._tx_delay_ticks))
        end = wrap(marker + from_seconds(after_rmarker_s(len(frame))))
        self.sending = Sending(marker, end, missed, bool(control & r.WAIT4RESP))
        self.counts["late" if missed else "started"] += 1
        if missed:
            self.raise_bits(r.HPDWARN)

    def _hand_over(self, frame: bytes, leaves_ticks: int) -> bool:
        """A frame with other settings than the air's is sent as well, but no receiver understands it."""
        if not can_send(self._memory):
            self.counts["sent-with-other-settings"] += 1
            return True
        return self._air.transmit(frame, leaves_ticks)

    def _frame(self, *, suppress_fcs: bool) -> bytes:
        """TFLEN octets from TXBOFFS on, the last two made by the chip (UM 3.1, 7.2.10)."""
        control = self._memory.get(r.TX_FCTRL)
        length, offset = control & 0x7F, control >> 22 & 0x3FF
        octets = self._memory.octets(r.TX_BUFFER)[offset : offset + length]
        return octets if suppress_fcs or length < 2 else octets[:-2] + fcs(octets[:-2])

    def _listen(self, *, delayed: bool) -> None:
        """RXENAB, with RXDLYE from DX_TIME on (UM 4.2)."""
        if self.sending is not None or self.listening_since is not None:
            self._misuse["rxenab-while-busy"] += 1
            return
        self.drop_bits(r.OF_RECEIVING)
        now = self._air.now_ticks()
        since = self._memory.get(r.DX_TIME) & DX_MASK if delayed else now
        if delayed and difference(since, now) < 0:
            self.raise_bits(r.HPDWARN)
        self.listening_since = since

    # What passes with time

    def update(self) -> None:
        """Show everything that has happened up to now."""
        now = self._air.now_ticks()
        sending = self.sending
        if sending is not None and not sending.missed:
            self._progress(sending, now)
        self._time_out(now)

    def finish(self) -> None:
        """The air reports that the frame's end has left."""
        if self.sending is not None and not self.sending.missed:
            self._progress(self.sending, self.sending.end_ticks)

    def fail(self) -> None:
        """The air reports that the frame came too late for it; nothing will show, as when a frame is aborted."""
        if self.sending is not None:
            self.sending.missed = True
            self.counts["refused-by-the-air"] += 1

    def _progress(self, sending: Sending, now: int) -> None:
        marker = sending.marker_ticks
        steps = (
            (marker - PREAMBLE_TICKS, r.TXFRB),
            (marker - _SFD_TICKS, r.TXPRS),
            (marker + _HEADER_TICKS, r.TXPHS),
            (sending.end_ticks, r.TXFRS),
        )
        shown = self._memory.get(r.SYS_STATUS)
        events = sum(event for ticks, event in steps if difference(now, wrap(ticks)) >= 0 and not shown & event)
        if difference(now, wrap(marker + _HEADER_TICKS)) >= 0:  # UM p. 102: there once the header is sent
            self._memory.set(r.TX_STAMP, marker + self._memory.get(r.TX_ANTD))
            self._memory.set(r.TX_RAWST, marker)
        if difference(now, sending.end_ticks) >= 0:
            self.sending = None
            self.counts["sent"] += 1
            if sending.then_listen:
                wait = (self._memory.get(r.ACK_RESP_T) & 0xFFFFF) * _TIMEOUT_TICKS
                self.drop_bits(r.OF_RECEIVING)
                self.listening_since = wrap(sending.end_ticks + wait)
        if events:
            self.raise_bits(events)

    def _time_out(self, now: int) -> None:
        """The receiver's frame wait timeout (UM 7.2.14)."""
        if self.listening_since is None or not self._memory.get(r.SYS_CFG) & r.RXWTOE:
            return
        if difference(now, self.listening_since) > self._memory.get(r.RX_FWTO) * _TIMEOUT_TICKS:
            self.listening_since = None
            self.raise_bits(r.RXRFTO)

    # Reception

    def receive(
        self,
        frame: bytes,
        antenna_ticks: int,
        diagnostics: Diagnostics,
        *,
        microcode: bool,
        fault: Fault | None = None,
    ) -> str:
        """Receive a frame whose RMARKER was at the antenna at that reading of the counter; what became of it.

        ``antenna_ticks`` counts the antenna delay in, as the chip's own stamp does before LDE_RXANTD is taken off.
        """
        memory = self._memory
        reason = self._why_not_received(antenna_ticks)
        if reason is not None:
            return reason
        if fault in ("header", "parity", "delimiter"):
            self._end_reception(_FAULT_EVENTS[fault], is_error=True)
            return "spoilt"
        is_good = is_intact(frame)
        stamped = bool(memory.get(r.PMSC_CTRL1) & r.LDERUNE)
        self._fill_registers(frame, diagnostics)
        memory.set(r.RX_RAWST, antenna_ticks & DX_MASK)
        if stamped and not microcode:
            self._end_reception(_COMPLETE, is_error=False)  # neither good nor bad: it waits for the stamp for ever
            return "without-microcode"
        events = _COMPLETE | (r.RXFCG if is_good else r.RXFCE)
        if stamped:
            wrong = _SUSPECT_TICKS if self.suspect else 0
            memory.set(r.RX_STAMP, wrap(antenna_ticks - memory.get(r.LDE_RXANTD) + wrong))
            events |= r.LDEERR if fault == "first-path" else r.LDEDONE
        self._end_reception(events, is_error=not is_good)
        if fault == "first-path" or not is_good:
            return "spoilt"
        return "suspect" if self.suspect else "heard"

    def _why_not_received(self, antenna_ticks: int) -> str | None:
        since = self.listening_since
        if since is None:
            return "receiver-off"
        if difference(wrap(antenna_ticks - PREAMBLE_TICKS + _MISSABLE_TICKS), since) < 0:
            return "preamble-missed"
        return None if can_receive(self._memory) else "other-settings"

    def _end_reception(self, events: int, *, is_error: bool) -> None:
        """The receiver turns itself off, but after an error with RXAUTR (UM 7.2.6)."""
        if is_error:
            self.suspect = True
        if not (is_error and self._memory.get(r.SYS_CFG) & r.RXAUTR):
            self.listening_since = None
        self.raise_bits(events)

    def _fill_registers(self, frame: bytes, diagnostics: Diagnostics) -> None:
        """RX_FINFO, the frame, and what was measured of it; zeros for what the air does not report.

        The formulas are those of UM 4.7.1, 4.7.2, 7.2.22 and 7.2.40.11, inverted.
        """
        memory = self._memory
        settings = 0b01 << 11 | 0b10 << 13 | 1 << 15 | 0b10 << 16 | 0b01 << 18  # 128 symbols, 6.8 Mbit/s
        symbols, cir_power = _cir_power(diagnostics.rx_power_dbm)
        whole = symbols == _ACCUMULATED_SYMBOLS  # then symbols of the delimiter were counted, too (UM 7.2.18, table 18)
        counted = symbols + (_SFD_COUNTED if whole else 0)
        memory.set(r.RX_FINFO, len(frame) | settings | counted << 20)
        memory.set(r.RXPACC_NOSAT, counted if whole else _ACCUMULATED_SYMBOLS)
        memory.fill(r.RX_BUFFER, frame)
        amplitudes = _first_path(diagnostics.first_path_power_dbm, symbols)
        for register, value in zip((r.FP_AMPL1, r.FP_AMPL2, r.FP_AMPL3), amplitudes, strict=True):
            memory.set(register, value)
        memory.set(r.CIR_PWR, cir_power)
        memory.set(r.STD_NOISE, 40)
        memory.set(r.FP_INDEX, 745 << 6)
        offset = 1e-6 * (diagnostics.carrier_offset_ppm or 0.0)
        carrier = round(-offset * CHANNEL_5_HZ / HZ_PER_STEP)  # UM p. 151: the minus comes from how it is measured
        memory.set(r.DRX_CAR_INT, _twos_complement(carrier, 21))
        memory.set(r.RX_TTCKI, _TRACKING_INTERVAL)
        memory.set(r.RX_TTCKO, _twos_complement(round(offset * _TRACKING_INTERVAL), 19))


def _cir_power(power_dbm: float | None) -> tuple[int, int]:
    """RXPACC and CIR_PWR with power = 10 log10(CIR_PWR · 2^17 / RXPACC²) - A.

    Where CIR_PWR would overflow fewer symbols are accumulated: a stand-in for the gain control.
    """
    if power_dbm is None:
        return _ACCUMULATED_SYMBOLS, 0
    ratio = 10.0 ** ((power_dbm + PRF_64_DB) / 10.0) / 2.0**17
    symbols = min(_ACCUMULATED_SYMBOLS, max(int(math.sqrt(_GREATEST / ratio)), 8))
    return symbols, min(round(ratio * symbols * symbols), _GREATEST)


def _first_path(power_dbm: float | None, symbols: int) -> tuple[int, int, int]:
    """FP_AMPL1 to 3 with power = 10 log10((F1² + F2² + F3²) / RXPACC²) - A; the middle one the greatest."""
    if power_dbm is None:
        return 0, 0, 0
    total = 10.0 ** ((power_dbm + PRF_64_DB) / 10.0) * symbols * symbols
    one, two = (min(round(math.sqrt(share * total)), _GREATEST) for share in (0.3, 0.4))
    three = math.sqrt(max(total - one * one - two * two, 0.0))
    return one, two, min(round(three), _GREATEST)


def _twos_complement(value: int, bits: int) -> int:
    """Two's complement, limited to the range of that many bits."""
    half = 1 << (bits - 1)
    return min(max(value, -half), half - 1) & ((1 << bits) - 1)
