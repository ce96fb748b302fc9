"""The chip's transmitter and receiver (DW1000 User Manual v2.12, sections 3 and 4).

Not modelled: double buffering, frame filtering, automatic acknowledgement, sniffing, sleep, long frames, and the
preamble timeout.
"""

from collections import Counter
from collections.abc import Callable
from typing import Final, Protocol

from msgspec import Struct

from skyless.air.airtime import HEADER_SYMBOL_S, PREAMBLE_SYMBOL_S, SFD_SYMBOLS, after_rmarker_s, preamble_s
from skyless.air.fcs import fcs
from skyless.constants import DELAYED_TX_GRANULARITY_TICKS
from skyless.simulation.dw1000 import bits
from skyless.simulation.dw1000 import registers as r
from skyless.simulation.dw1000.memory import Memory
from skyless.simulation.dw1000.settings import is_tuned_to_send
from skyless.ticks import difference, from_seconds, wrap

DX_MASK: Final = ~(DELAYED_TX_GRANULARITY_TICKS - 1)
PREAMBLE_TICKS: Final = from_seconds(preamble_s())
POWER_UP_TICKS: Final = from_seconds(10e-6)
"""What the transmitter needs to power up before the preamble; less gives TXPUTE (assumed: the manual tells none)."""
AT_ONCE_TICKS: Final = from_seconds(0.5e-3)
"""When a frame without a time leaves: soon enough for the emulated air, which wants to know of it before."""
TIMEOUT_TICKS: Final = 512 * 128
"""Unit of RX_FWTO: 1.026 µs (UM p. 79)."""
W4R_TICKS: Final = 512 * 128
_SFD_TICKS: Final = from_seconds(SFD_SYMBOLS * PREAMBLE_SYMBOL_S)
_HEADER_TICKS: Final = from_seconds(21 * HEADER_SYMBOL_S)


class Air(Protocol):
    """What the chip's antenna is in."""

    def now_ticks(self) -> int:
        """The node's 40-bit counter; the chip shows it in steps of 512."""

    def transmit(self, frame: bytes, leaves_ticks: int) -> bool:
        """Have the RMARKER leave the antenna at that reading of the counter; False if it is too late."""

    def withdraw(self) -> None:
        """Take back what has not been sent."""


class Sending(Struct):
    """A frame that waits or is on its way; ticks without antenna delay."""

    marker_ticks: int
    end_ticks: int
    never: bool
    """Its time has passed: the chip would send it when the counter comes there again, 17 s later."""
    then_listen: bool


class Transceiver:
    """Transmitter and receiver, of which one works at a time."""

    def __init__(self, memory: Memory, air: Air, tx_delay_ticks: int, misuse: Counter[str]) -> None:
        """``tx_delay_ticks`` is what lies between the chip and its antenna in truth."""
        self._memory, self._air, self._tx_delay_ticks, self._misuse = memory, air, tx_delay_ticks, misuse
        self.counts: Counter[str] = Counter()
        self.sending: Sending | None = None
        self.listening_since: int | None = None
        self.suspect = False
        """After an error the receiver wants a reset, or the next stamp is wrong (UM 4.1.6)."""
        self.on_change: Callable[[], None] = lambda: None

    def reset(self) -> None:
        """Everything off."""
        self._withdraw()
        self.sending, self.listening_since, self.suspect = None, None, False

    # Status

    def raise_bits(self, events: int) -> None:
        """Let events show in SYS_STATUS."""
        self._memory.put(r.SYS_STATUS, self._memory.get(r.SYS_STATUS) | events)
        self.on_change()

    def drop_bits(self, events: int) -> None:
        """Forget events."""
        self._memory.put(r.SYS_STATUS, self._memory.get(r.SYS_STATUS) & ~events)
        self.on_change()

    # Commands (UM 7.2.15)

    def command(self, control: int) -> None:
        """Follow what was written into SYS_CTRL."""
        if control & bits.TRXOFF:
            self.off()
        if control & bits.TXSTRT:
            self._start(control)
        elif control & bits.RXENAB:
            self._listen(delayed=bool(control & bits.RXDLYE))

    def off(self) -> None:
        """TRXOFF: abort whatever is under way; HPDWARN goes with what it warned of (UM p. 91)."""
        self._withdraw()
        self.sending, self.listening_since = None, None
        self.drop_bits(bits.HPDWARN)

    def _withdraw(self) -> None:
        if self.sending is not None and not self.sending.never:
            self._air.withdraw()
            self.counts["withdrawn"] += 1

    def _start(self, control: int) -> None:
        """TXSTRT, with TXDLYS at DX_TIME, whose low nine bits do not count (UM p. 26)."""
        if self.sending is not None or self.listening_since is not None:
            self._misuse["txstrt-while-busy"] += 1
            return
        self.drop_bits(bits.OF_SENDING | bits.HPDWARN)
        now = self._air.now_ticks()
        delayed = bool(control & bits.TXDLYS)
        marker = self._memory.get(r.DX_TIME) if delayed else wrap(now + AT_ONCE_TICKS)
        marker &= DX_MASK
        frame = self._frame(suppress_fcs=bool(control & bits.SFCST))
        ahead = difference(marker, now) - PREAMBLE_TICKS
        never = ahead < 0
        if not never and ahead < POWER_UP_TICKS:
            self.raise_bits(bits.TXPUTE)
        if not never:
            never = not self._hand_over(frame, wrap(marker + self._tx_delay_ticks))
        end = wrap(marker + from_seconds(after_rmarker_s(len(frame))))
        self.sending = Sending(marker, end, never, bool(control & bits.WAIT4RESP))
        self.counts["late" if never else "started"] += 1
        if never:
            self.raise_bits(bits.HPDWARN)

    def _hand_over(self, frame: bytes, leaves_ticks: int) -> bool:
        """A frame with other settings than the air's is sent as well, but nobody there understands it."""
        if not is_tuned_to_send(self._memory):
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
        self.drop_bits(bits.OF_RECEIVING)
        now = self._air.now_ticks()
        since = self._memory.get(r.DX_TIME) & DX_MASK if delayed else now
        if delayed and difference(since, now) < 0:
            self.raise_bits(bits.HPDWARN)
        self.listening_since = since

    # What passes with time

    def settle(self) -> None:
        """Let everything show that has happened up to now."""
        now = self._air.now_ticks()
        sending = self.sending
        if sending is not None and not sending.never:
            self._progress(sending, now)
        self._time_out(now)

    def finish(self) -> None:
        """The air says that the frame's end has left."""
        if self.sending is not None and not self.sending.never:
            self._progress(self.sending, self.sending.end_ticks)

    def fail(self) -> None:
        """The air says that the frame came too late for it after all; nothing will show, as when a frame is aborted."""
        if self.sending is not None:
            self.sending.never = True
            self.counts["refused-by-the-air"] += 1

    def _progress(self, sending: Sending, now: int) -> None:
        marker = sending.marker_ticks
        steps = (
            (marker - PREAMBLE_TICKS, bits.TXFRB),
            (marker - _SFD_TICKS, bits.TXPRS),
            (marker + _HEADER_TICKS, bits.TXPHS),
            (sending.end_ticks, bits.TXFRS),
        )
        shown = self._memory.get(r.SYS_STATUS)
        events = sum(event for ticks, event in steps if difference(now, wrap(ticks)) >= 0 and not shown & event)
        if difference(now, wrap(marker + _HEADER_TICKS)) >= 0:  # UM p. 102: there once the header is sent
            self._memory.put(r.TX_STAMP, marker + self._memory.get(r.TX_ANTD))
            self._memory.put(r.TX_RAWST, marker)
        if difference(now, sending.end_ticks) >= 0:
            self.sending = None
            self.counts["sent"] += 1
            if sending.then_listen:
                wait = (self._memory.get(r.ACK_RESP_T) & 0xFFFFF) * W4R_TICKS
                self.drop_bits(bits.OF_RECEIVING)
                self.listening_since = wrap(sending.end_ticks + wait)
        if events:
            self.raise_bits(events)

    def _time_out(self, now: int) -> None:
        """The receiver's frame wait timeout (UM 7.2.14)."""
        if self.listening_since is None or not self._memory.get(r.SYS_CFG) & bits.RXWTOE:
            return
        if difference(now, self.listening_since) > self._memory.get(r.RX_FWTO) * TIMEOUT_TICKS:
            self.listening_since = None
            self.raise_bits(bits.RXRFTO)
