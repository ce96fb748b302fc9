"""The chip's transmitter and receiver (DW1000 User Manual v2.12, sections 3, 4, 7.2.18 to 7.2.23).

Modelled are delayed transmission, and reception until a frame, an error or the end of its window, into one or two
buffers. Not modelled: automatic re-enabling (RXAUTR), filtering, acknowledgement, sniffing, long frames, other
timeouts.
"""

import cmath
import math
import struct
import zlib
from collections import Counter
from typing import Final, Literal, Protocol

from msgspec import Struct

from skyless.core.air.frame import (
    HEADER_SYMBOL_S,
    PREAMBLE_SYMBOL_S,
    SFD_SYMBOLS,
    Diagnostics,
    after_rmarker_s,
    fcs,
    is_intact,
    preamble_s,
)
from skyless.core.ticks import CHANNEL_5_HZ, CHIP_RATE_HZ, DELAYED_TX_GRANULARITY_TICKS, difference, from_seconds, wrap
from skyless.sim.dw1000 import registers as r
from skyless.sim.dw1000.registers import Memory
from skyless.site.channel import ChannelModel

DX_MASK: Final = ~(DELAYED_TX_GRANULARITY_TICKS - 1)
PREAMBLE_TICKS: Final = from_seconds(preamble_s())
_POWER_UP_TICKS: Final = from_seconds(10e-6)
"""Power-up time of the transmitter before the preamble; less gives TXPUTE (assumed: the manual states none)."""
_SFD_TICKS: Final = from_seconds(SFD_SYMBOLS * PREAMBLE_SYMBOL_S)
_HEADER_TICKS: Final = from_seconds(21 * HEADER_SYMBOL_S)

Fault = Literal["header", "parity", "delimiter", "first-path"]
_FAULT_EVENTS: Final[dict[Fault, int]] = {
    "header": r.RXPRD | r.RXSFDD | r.RXPHE,
    "parity": r.RXPRD | r.RXSFDD | r.RXPHD | r.RXRFSL,
    "delimiter": r.RXPRD | r.RXSFDTO,
}
"""SYS_STATUS events of a frame damaged in its header, in its data, or before its delimiter."""
_COMPLETE: Final = r.RXPRD | r.RXSFDD | r.RXPHD | r.RXDFR
"""SYS_STATUS events of every complete frame."""

_NEEDED_SYMBOLS: Final = 64
"""Preamble symbols of 128 needed by a receiver that is enabled while a frame arrives (assumed)."""
_MISSABLE_TICKS: Final = from_seconds((128 - _NEEDED_SYMBOLS) * PREAMBLE_SYMBOL_S)

_SUSPECT_TICKS: Final = 1024
"""Error of the stamp after an error without a receiver reset (assumed; UM 4.1.6 only warns of it)."""

AGC_LOSS_DB: Final = 3.0
"""How much weaker all is received unless AGC_TUNE3 is set (assumed); what is then below the sensitivity is lost."""
PRF_64_DB: Final = 121.74
"""The constant of both powers at 64 MHz PRF (UM 4.7.1, 4.7.2)."""
_ACCUMULATED_SYMBOLS: Final = 118
"""Accumulated symbols of a preamble of 128: assumed, as some pass before detection."""
_SFD_COUNTED: Final = 5
"""Delimiter symbols that RXPACC counts if it equals RXPACC_NOSAT, for the standard one (UM table 18)."""
HZ_PER_STEP: Final = CHIP_RATE_HZ / 1024 / 131072
"""Step of the carrier integrator (UM 7.2.40.11), at 850 kbit/s and above."""
_CARRIER_HALF: Final = 1 << 20
"""The integrator has 21 bits, in two's complement."""
_GREATEST: Final = 0xFFFF

_FILES_OF_BUFFER: Final = (r.RX_FINFO, r.RX_BUFFER, r.STD_NOISE, r.RX_TTCKO, r.RX_STAMP)
"""Register files that exist in each of the two receive buffers (UM 4.3.1)."""

RCPHASE_STEPS: Final = 128
"""Steps of RCPHASE in a turn."""
_STD_NOISE: Final = 40
"""Of the accumulator's samples (assumed)."""
_FIRST_PATH_SAMPLE: Final = 740
"""Approximate index of the first path in the accumulator (assumed)."""
_GREATEST_SAMPLE: Final = 0x7FFF
_SAMPLE: Final = struct.Struct("<2h")


class Air(Protocol):
    """The medium around the chip's antenna."""

    def now_ticks(self) -> int:
        """The node's 40-bit counter; the chip shows it in steps of 512."""

    def transmit(self, frame: bytes, leaves_ticks: int) -> bool:
        """Emit the RMARKER at that counter reading. Returns False if it is too late."""

    def withdraw(self) -> None:
        """Cancel what has not been sent."""


class Sending(Struct):
    """A pending or transmitting frame; ticks without antenna delay."""

    marker_ticks: int
    end_ticks: int
    missed: bool
    """Its time has passed: the chip would send it when the counter returns there, 17 s later."""


class Transceiver:
    """Transmitter and receiver, of which one works at a time."""

    def __init__(self, memory: Memory, air: Air, tx_delay_ticks: int, misuse: Counter[str]) -> None:
        """``tx_delay_ticks`` is the true delay between the chip and its antenna."""
        self._memory, self._air, self._tx_delay_ticks, self._misuse = memory, air, tx_delay_ticks, misuse
        self.counts: Counter[str] = Counter()
        self.sending: Sending | None = None
        self.listening_since: int | None = None
        """When the receiver was, or will be, enabled."""
        self.suspect = False
        """After an error the receiver needs a reset, otherwise the next stamp is wrong (UM 4.1.6)."""
        self.receiving_ticks = 0
        """Total time that the receiver has been on, up to the last ``update``."""
        self._counted_ticks = 0
        self._window_end_ticks: int | None = None
        self._hidden = {one.file: bytearray(r.FILE_LENGTHS[one.file]) for one in _FILES_OF_BUFFER}
        """The receive buffer that the host does not see."""
        self._hidden_events = 0
        self._host_buffer = self._chip_buffer = 0
        self._is_exchanged = False

    def reset(self) -> None:
        """Turn everything off."""
        self.off()
        self.suspect = False
        self._host_buffer = self._chip_buffer = self._hidden_events = 0

    # Status

    @property
    def buffer_pointers(self) -> int:
        """HSRBP and ICRBP."""
        return (r.HSRBP if self._host_buffer else 0) | (r.ICRBP if self._chip_buffer else 0)

    def raise_bits(self, events: int) -> None:
        """Set events in SYS_STATUS."""
        self._memory.set(r.SYS_STATUS, self._memory.get(r.SYS_STATUS) | events)

    def drop_bits(self, events: int) -> None:
        """Clear events."""
        self._memory.set(r.SYS_STATUS, self._memory.get(r.SYS_STATUS) & ~events)

    # Commands (UM 7.2.15)

    def command(self, control: int) -> None:
        """Execute a write to SYS_CTRL."""
        if control & r.TRXOFF:
            self.off()
            control &= ~r.TXSTRT  # begun and aborted at once, which sets the delimiter up; nothing is sent (UM 5.3.1.2)
        if control & r.HRBPT:
            self._host_buffer ^= 1
            self._exchange_buffers()
        if control & r.TXSTRT:
            self._start()
        elif control & r.RXENAB:
            self._listen(delayed=bool(control & r.RXDLYE))

    def off(self) -> None:
        """TRXOFF: abort everything; HPDWARN is cleared with its cause (UM p. 91)."""
        if self.sending is not None and not self.sending.missed:
            self._air.withdraw()
            self.counts["withdrawn"] += 1
        self.stop_listening()
        self.sending = None
        self.drop_bits(r.HPDWARN)

    def _start(self) -> None:
        """TXSTRT and TXDLYS: send at DX_TIME, whose low nine bits are ignored (UM p. 26)."""
        if self.sending is not None or self.listening_since is not None:
            self._misuse["txstrt-while-busy"] += 1
            return
        self.drop_bits(r.OF_SENDING | r.HPDWARN)
        now = self._air.now_ticks()
        marker = self._memory.get(r.DX_TIME) & DX_MASK
        frame = self._frame()
        ahead = difference(marker, now) - PREAMBLE_TICKS
        missed = ahead < 0
        if not missed and ahead < _POWER_UP_TICKS:
            self.raise_bits(r.TXPUTE)
        if not missed:
            missed = not self._hand_over(frame, wrap(marker + self._tx_delay_ticks))
        end = wrap(marker + from_seconds(after_rmarker_s(len(frame))))
        self.sending = Sending(marker, end, missed)
        self.counts["late" if missed else "started"] += 1
        if missed:
            self.raise_bits(r.HPDWARN)

    def _hand_over(self, frame: bytes, leaves_ticks: int) -> bool:
        """Pass a frame to the air; with other settings than the air's it is sent, but no receiver understands it."""
        if not can_send(self._memory):
            self.counts["sent-with-other-settings"] += 1
            return True
        return self._air.transmit(frame, leaves_ticks)

    def _frame(self) -> bytes:
        """TFLEN octets from TXBOFFS on, the last two generated by the chip (UM 3.1, 7.2.10)."""
        control = self._memory.get(r.TX_FCTRL)
        length, offset = control & 0x7F, control >> 22 & 0x3FF
        octets = self._memory.octets(r.TX_BUFFER)[offset : offset + length]
        return octets if length < 2 else octets[:-2] + fcs(octets[:-2])

    def _listen(self, *, delayed: bool) -> None:
        """RXENAB, and with RXDLYE at DX_TIME (UM 4.2)."""
        if self.sending is not None or self.listening_since is not None:
            self._misuse["rxenab-while-busy"] += 1
            return
        memory, since = self._memory, self._air.now_ticks()
        has_two = not memory.get(r.SYS_CFG) & r.DIS_DRXB
        self.drop_bits(r.OF_RECEIVING & ~r.OF_BUFFER if has_two else r.OF_RECEIVING)
        if delayed:
            now, since = since, memory.get(r.DX_TIME) & DX_MASK
            if difference(since, now) < 0:
                self.raise_bits(r.HPDWARN)  # it would go on when the counter comes there again, 17 s later
                return
        self.listening_since = self._counted_ticks = since
        self._window_end_ticks = None
        if memory.get(r.SYS_CFG) & r.RXWTOE:
            self._window_end_ticks = wrap(since + (memory.get(r.RX_FWTO) << 16))  # of 512 chips (UM 7.2.14)

    def stop_listening(self) -> None:
        """Turn the receiver off."""
        self._count_receiving(self._air.now_ticks())
        self.listening_since = self._window_end_ticks = None

    def _count_receiving(self, until_ticks: int) -> None:
        if self.listening_since is not None and difference(until_ticks, self._counted_ticks) > 0:
            self.receiving_ticks += difference(until_ticks, self._counted_ticks)
            self._counted_ticks = until_ticks

    def _exchange_buffers(self) -> None:
        """Switch to the other receive buffer."""
        shown = self._memory.get(r.SYS_STATUS)
        self._memory.exchange(self._hidden)
        self._memory.set(r.SYS_STATUS, shown & ~r.OF_BUFFER | self._hidden_events)
        self._hidden_events = shown & r.OF_BUFFER

    # What passes with time

    def update(self) -> None:
        """Update the status to the present."""
        now = self._air.now_ticks()
        if self.sending is not None and not self.sending.missed:
            self._progress(self.sending, now)
        if self._window_end_ticks is not None and difference(now, self._window_end_ticks) >= 0:
            self._count_receiving(self._window_end_ticks)
            self.listening_since = self._window_end_ticks = None
            self.suspect = True
            self.raise_bits(r.RXRFTO)
        self._count_receiving(now)

    @property
    def window_left_ticks(self) -> int | None:
        """Time left in the receiver's window, if it has one."""
        return None if self._window_end_ticks is None else difference(self._window_end_ticks, self._air.now_ticks())

    def finish(self) -> None:
        """The air reports that the frame has been sent."""
        if self.sending is not None and not self.sending.missed:
            self._progress(self.sending, self.sending.end_ticks)

    def fail(self) -> None:
        """The air reports that the frame came too late; nothing will show it, as when a frame is aborted."""
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
        if difference(now, sending.end_ticks) >= 0:
            self.sending = None
            self.counts["sent"] += 1
        if events:
            self.raise_bits(events)

    # Reception

    def receive(
        self,
        frame: bytes,
        antenna_ticks: int,
        diagnostics: Diagnostics,
        *,
        microcode: bool,
        fault: Fault | None = None,
        carrier_phase_cycles: float | None = None,
    ) -> str:
        """Receive a frame whose RMARKER was at the antenna at this counter reading. Returns the outcome.

        ``antenna_ticks`` includes the antenna delay, like the chip's own stamp before LDE_RXANTD is subtracted.
        """
        memory = self._memory
        reason = self._why_not_received(antenna_ticks)
        if memory.get(r.AGC_TUNE3) != TUNED_TO_RECEIVE["AGC_TUNE3"]:
            power_dbm, first_dbm = (
                None if power is None else power - AGC_LOSS_DB
                for power in (diagnostics.rx_power_dbm, diagnostics.first_path_power_dbm)
            )
            diagnostics = Diagnostics(power_dbm, first_dbm, diagnostics.carrier_offset_ppm)
            if power_dbm is not None and power_dbm < ChannelModel().sensitivity_dbm:
                reason = reason or "too-weak"
        if reason is not None:
            return reason
        if fault in ("header", "parity", "delimiter"):
            self._end_reception(_FAULT_EVENTS[fault], is_error=True)
            return "spoilt"
        if self._chip_buffer != self._host_buffer:
            self._exchange_buffers()  # until the reception has ended
            self._is_exchanged = True
        if memory.get(r.SYS_STATUS) & r.RXFCG:  # the host has not read it, and this frame spoils it (UM 4.3.5)
            memory.set(r.RX_STAMP, ~memory.get(r.RX_STAMP))
            self._end_reception(r.RXOVRR, is_error=True)
            return "overrun"
        is_good = is_intact(frame)
        stamped = bool(memory.get(r.PMSC_CTRL1) & r.LDERUNE)
        self._fill_registers(frame, diagnostics)
        self._fill_accumulator(frame, carrier_phase_cycles)
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
        """End a reception; the receiver turns itself off."""
        self.suspect = self.suspect or is_error
        self.stop_listening()
        self.raise_bits(events)
        if self._is_exchanged:
            self._exchange_buffers()
            self._is_exchanged = False
        if events & r.RXFCG and not self._memory.get(r.SYS_CFG) & r.DIS_DRXB:
            self._chip_buffer ^= 1

    def _fill_registers(self, frame: bytes, diagnostics: Diagnostics) -> None:
        """Set RX_FINFO, the frame, and its measurements; zeros if the air does not report them.

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
        offset = 1e-6 * (diagnostics.carrier_offset_ppm or 0.0)
        carrier = round(-offset * CHANNEL_5_HZ / HZ_PER_STEP)  # UM p. 151: the minus comes from how it is measured
        memory.set(r.DRX_CAR_INT, min(max(carrier, -_CARRIER_HALF), _CARRIER_HALF - 1) & (2 * _CARRIER_HALF - 1))

    def _fill_accumulator(self, frame: bytes, phase_cycles: float | None) -> None:
        """Set RCPHASE, FP_INDEX and four samples from there; zeros if the air does not report a phase.

        The second sample's angle minus RCPHASE is the phase; its neighbours have others. The first path's index, and
        RCPHASE within four steps, are derived from the frame's octets instead of chance. FP_AMPL3, FP_AMPL2 and
        FP_AMPL1 are the sizes of the second, third and fourth (UM 7.2.20, 7.2.23).
        """
        memory, chance = self._memory, zlib.crc32(frame)
        turned = chance % 9 - 4
        index = (_FIRST_PATH_SAMPLE << 6) + (chance >> 8) % 1024
        memory.set(r.RX_TTCKO, turned % RCPHASE_STEPS << 32)
        memory.set(r.FP_INDEX, index)
        memory.set(r.STD_NOISE, _STD_NOISE)
        memory.fill(r.ACC_MEM, bytes(r.ACC_MEM.length))
        if phase_cycles is None:
            return
        angle = 2.0 * math.pi * (phase_cycles + turned / RCPHASE_STEPS)
        sizes = [min(memory.get(one), _GREATEST_SAMPLE) for one in (r.FP_AMPL3, r.FP_AMPL2, r.FP_AMPL1)]
        values = [cmath.rect(size, angle + step) for step, size in enumerate([sizes[0] // 2, *sizes], -1)]
        samples = b"".join(_SAMPLE.pack(round(one.real), round(one.imag)) for one in values)
        memory.fill(r.ACC_MEM, samples, _SAMPLE.size * (index >> 6))


def _cir_power(power_dbm: float | None) -> tuple[int, int]:
    """RXPACC and CIR_PWR with power = 10 log10(CIR_PWR · 2^17 / RXPACC²) - A.

    If CIR_PWR would overflow, fewer symbols are accumulated: a substitute for the gain control.
    """
    if power_dbm is None:
        return _ACCUMULATED_SYMBOLS, 0
    ratio = 10.0 ** ((power_dbm + PRF_64_DB) / 10.0) / 2.0**17
    symbols = min(_ACCUMULATED_SYMBOLS, max(int(math.sqrt(_GREATEST / ratio)), 8))
    return symbols, min(round(ratio * symbols * symbols), _GREATEST)


def _first_path(power_dbm: float | None, symbols: int) -> tuple[int, int, int]:
    """FP_AMPL1 to 3 with power = 10 log10((F1² + F2² + F3²) / RXPACC²) - A; the middle one is the largest."""
    if power_dbm is None:
        return 0, 0, 0
    total = 10.0 ** ((power_dbm + PRF_64_DB) / 10.0) * symbols * symbols
    one, two = (min(round(math.sqrt(share * total)), _GREATEST) for share in (0.3, 0.4))
    three = math.sqrt(max(total - one * one - two * two, 0.0))
    return one, two, min(round(three), _GREATEST)


# Settings: channel 5, PRF 64 MHz, 6.8 Mbit/s, a preamble of 128 symbols, code 9. A chip with others receives nothing
# and is not received. Tuning registers count, too: a wrong value in a driver has to show, although a real receiver
# would still receive something. AGC_TUNE3 only weakens reception, for drivers of real boards leave it unset.

_CHANNEL: Final = 5
_CODE: Final = 9
_PRF_64: Final = 0b10
_RATE_6M8: Final = 0b10
_PREAMBLE_128: Final = 0b0101
"""TXPSR and, above it, PE (UM 7.2.10: table 16)."""

TUNED_TO_RECEIVE: Final[dict[str, int]] = {
    "AGC_TUNE1": 0x889B,  # table 24
    "AGC_TUNE2": 0x2502A907,  # table 25
    "AGC_TUNE3": 0x0035,  # table 26
    "DRX_TUNE0B": 0x0001,  # table 30
    "DRX_TUNE1A": 0x008D,  # table 31
    "DRX_TUNE1B": 0x0020,  # table 32
    "DRX_TUNE2": 0x313B006B,  # table 33
    "DRX_TUNE4H": 0x0028,  # table 34
    "RF_RXCTRLH": 0xD8,  # table 37
    "FS_PLLCFG": 0x0800041D,  # table 43
    "FS_PLLTUNE": 0xBE,  # table 44
    "LDE_CFG2": 0x0607,  # table 50
    "LDE_REPC": 0x28F4,  # table 51, code 9
}
"""Values of registers for channel 5, PRF 64 MHz, code 9, 6.8 Mbit/s, a preamble of 128 and PAC 8."""

TUNED_TO_SEND: Final[dict[str, int]] = {
    "RF_TXCTRL": 0x001E3FE0,  # table 38
    "TC_PGDELAY": 0xC0,  # table 40
    "FS_PLLCFG": 0x0800041D,
    "FS_PLLTUNE": 0xBE,
}

_ALSO_WORK: Final[dict[str, tuple[int, ...]]] = {
    "RF_TXCTRL": (0x001E3FE3,),  # UM 2.16
    "TC_PGDELAY": (0xB5,),  # UM 2.18
    "FS_PLLTUNE": (0xA6,),  # before UM 2.12
}
"""Values of other editions of the manual, with which drivers run on real boards."""


def can_receive(memory: Memory) -> bool:
    """Whether the receiver understands the frames on the air."""
    control, config = memory.get(r.CHAN_CTRL), memory.get(r.SYS_CFG)
    return (
        control >> 4 & 0xF == control & 0xF == _CHANNEL
        and control >> 18 & 0b11 == _PRF_64
        and control >> 27 == _CODE
        and not control & (1 << 17 | 1 << 21)  # DWSFD, RNSSFD: another start-of-frame delimiter
        and not config & (r.RXM110K | r.PHR_MODE)
        and _has(memory, TUNED_TO_RECEIVE)
    )


def can_send(memory: Memory) -> bool:
    """Whether receivers understand what the transmitter would send."""
    control, frame = memory.get(r.CHAN_CTRL), memory.get(r.TX_FCTRL)
    return (
        control & 0xF == _CHANNEL
        and control >> 22 & 0x1F == _CODE
        and not control & (1 << 17 | 1 << 20)  # DWSFD, TNSSFD
        and frame >> 16 & 0b11 == _PRF_64
        and frame >> 13 & 0b11 == _RATE_6M8
        and frame >> 18 & 0b1111 == _PREAMBLE_128
        and not memory.get(r.SYS_CFG) & r.PHR_MODE
        and _has(memory, TUNED_TO_SEND)
    )


def _has(memory: Memory, values: dict[str, int]) -> bool:
    return all(
        memory.get(r.ALL_REGISTERS[name]) in (value, *_ALSO_WORK.get(name, ()))
        for name, value in values.items()
        if name != "AGC_TUNE3"
    )
