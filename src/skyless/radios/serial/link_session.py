"""One conversation with a board over the serial link, from HELLO on (``docs/serial.md``). No I/O, no clock."""

from collections import Counter, deque
from collections.abc import Callable
from typing import Final

from skyless.air.reception import Reception, Transmission
from skyless.firmware import link
from skyless.radios.interface import AntennaDelays, Gone, Hint, Late, Listener, Restarted, Sent
from skyless.radios.serial.board_clock import BoardClock
from skyless.radios.serial.link_records import Done, Heard, Hello, NotDone, Record, Status, TooLate, decode
from skyless.ticks import wrap

POLL_S: Final = 0.5
SILENCE_S: Final = 3.0
PENDING: Final = 16
"""Frames whose end the board has not told; a board holds one, so of older ones the answer was lost on the line."""

ANSWER_S: Final = 1.0
"""A HELLO that comes so long after it was asked for was not asked for: the board has started."""
IDLE_S: Final = 5.0
"""A board that has been configured for so long and does not listen will not."""
STARTS: Final = 3
STARTS_S: Final = 60.0
"""A board that starts so often within so long does not start because somebody wants it to."""

_REASONS: Final = {
    link.REFUSED_SETTING: "it has not these settings",
    link.REFUSED_MALFORMED: "it did not understand it",
    link.REFUSED_RADIO: "its radio does not answer or start",
}


class LinkSession:
    """What is said and heard since the port was opened."""

    def __init__(
        self,
        place: str,
        delays: AntennaDelays,
        send: Callable[[bytes], None],
        tell: Listener,
        counters: Counter[str],
        *,
        transmits: bool = False,
    ) -> None:
        """``place`` is what messages call the port; ``transmits``: a board that only listens is of no use."""
        self.clock = BoardClock()
        self.ready = False
        self.hello: Hello | None = None
        self.status: Status | None = None
        """The newest one."""
        self._place, self._delays, self._send, self._tell, self.counters = place, delays, send, tell, counters
        self._reader, self._writer = link.Reader(), link.Writer()
        self._expected: int | None = None
        self._pending: dict[int, int] = {}
        self._bytes = 0
        self._refused = self._told = ""
        self._transmits = transmits
        self._heard_s = self._asked_s = 0.0
        self._starts: deque[float] = deque(maxlen=STARTS)
        self._told_starts = self._told_idle = False
        self._idle_polls = 0

    def begin(self, host_s: float) -> None:
        """Say the first words."""
        self._heard_s = host_s
        self._send(b"\0")
        self._ask_hello(host_s)

    def poll(self, host_s: float) -> str | None:
        """To be called every ``POLL_S``; tells why the board is to be given up, None while it is not."""
        if host_s - self._heard_s > SILENCE_S:
            return self._silence()
        if self.hello is None or self._refused:
            self._ask_hello(host_s)
        elif self.ready:
            self._say(self._writer.ask(link.ASK_STATUS))
        else:
            self._configure()
            self._note_idle()
        return None

    def _note_idle(self) -> None:
        """Say once that a board answers and yet does not listen, whatever it is told."""
        self._idle_polls += 1
        if self._idle_polls * POLL_S >= IDLE_S and not self._told_idle:
            self._told_idle = True
            self._tell(Hint(f"the board at {self._place} answers, but does not start to receive: does its radio work?"))

    def _ask_hello(self, host_s: float) -> None:
        self._asked_s = host_s
        self._say(self._writer.ask(link.ASK_HELLO))

    def _silence(self) -> str:
        if self.hello is not None:
            return f"the board at {self._place} says nothing any more"
        if self._bytes:
            return f"what comes from {self._place} is no serial link of Skyless ({self._bytes} bytes); wrong baud rate?"
        return f"no board answers at {self._place}"

    def transmit(self, transmission: Transmission) -> None:
        """Have a frame sent; without a board that is ready it is late."""
        if not self.ready:
            self._tell(Late(transmission.tx_ticks))
            return
        dx_ticks = wrap(transmission.tx_ticks - self._delays.tx_ticks)
        self._pending[dx_ticks] = transmission.tx_ticks
        if len(self._pending) > PENDING:
            del self._pending[next(iter(self._pending))]
        dx, frame = dx_ticks.to_bytes(5, "little"), transmission.frame
        self._say(self._writer.tx_at(bytearray(dx), bytearray(frame), len(frame)))

    def hear(self, data: bytes, host_s: float) -> None:
        """Take what came from the port."""
        self._bytes += len(data)
        reader, buffer, at = self._reader, bytearray(data), 0
        before = reader.garbled + reader.overlong
        while at < len(buffer):
            at = reader.read(buffer, at, len(buffer))
            if reader.length:
                self._hear_record(bytes(reader.record[: reader.length]), host_s)
        self._count("garbled-record", reader.garbled + reader.overlong - before)

    def _hear_record(self, raw: bytes, host_s: float) -> None:
        record = decode(raw)
        if isinstance(record, Hello):
            self._expected = None
        elif self.hello is None:
            return  # of the time before this conversation
        if not self._is_next(raw[1]):
            return
        if isinstance(record, str):
            self.counters[record] += 1
            return
        self._heard_s = host_s
        self._follow(record, host_s)

    def _is_next(self, number: int) -> bool:
        """Count what is missing before a record; False for a copy of the one before."""
        missing = 0 if self._expected is None else (number - self._expected) & 0xFF
        if missing == 0xFF:
            self.counters["copied-record"] += 1
            return False
        self._expected = (number + 1) & 0xFF
        self._count("lost-record", missing)
        return True

    def _count(self, reason: str, times: int) -> None:
        if times:
            self.counters[reason] += times

    def _follow(self, record: Record, host_s: float) -> None:
        if isinstance(record, Heard):
            if self.ready:
                self.clock.hear(record.rx_ticks, host_s)
                self._tell(Reception(record.frame, record.rx_ticks, host_s, record.diagnostics))
        elif isinstance(record, Done):
            self._sent(record)
        elif isinstance(record, TooLate):
            tx_ticks = self._pending.pop(record.dx_ticks, None)
            if tx_ticks is not None:
                self._tell(Late(tx_ticks))
        elif isinstance(record, Status):
            self._learn(record, host_s)
        elif isinstance(record, Hello):
            self._greet(record, host_s)
        else:
            self._complain(record)

    def _sent(self, record: Done) -> None:
        tx_ticks = self._pending.pop(record.dx_ticks, None)
        if tx_ticks is None:
            return
        if record.tx_ticks != tx_ticks:
            self.counters["sent-at-another-time"] += 1
        self._tell(Sent(tx_ticks))

    def _greet(self, hello: Hello, host_s: float) -> None:
        """Configure a board of this version; one that has greeted before may have started anew, its state will tell."""
        if self.hello is not None and host_s - self._asked_s > ANSWER_S:
            self._note_start(host_s)
        greeted, self.hello = self.hello is not None and not self._refused, hello
        if hello.major != link.MAJOR:
            self._refuse(
                f"the board at {self._place} speaks version {hello.major}.{hello.minor} of the serial link, this "
                f"program {link.MAJOR}.{link.MINOR}; bring the board's firmware and Skyless to the same release"
            )
        elif hello.rate_khz != link.RATE_KHZ or hello.counter_bits != link.COUNTER_BITS:
            self._refuse(
                f"the board at {self._place} counts {hello.rate_khz} kHz in {hello.counter_bits} bits, not "
                f"{link.RATE_KHZ} in {link.COUNTER_BITS}: its radio is none that Skyless knows"
            )
        elif self._transmits and not hello.can_transmit:
            self._refuse(f"the board at {self._place} only listens; an anchor needs one that can transmit")
        else:
            self._refused = ""
            if greeted:
                self._say(self._writer.ask(link.ASK_STATUS))
            else:
                self._configure()

    def _note_start(self, host_s: float) -> None:
        """Count that the board has started anew, and say so once when it does again and again."""
        self.counters["board-restart"] += 1
        self._idle_polls = 0
        starts = self._starts
        if starts and host_s - starts[-1] > STARTS_S:
            self._told_starts = False
        starts.append(host_s)
        within_s = host_s - starts[0]
        if len(starts) == STARTS and within_s <= STARTS_S and not self._told_starts:
            self._told_starts = True
            often = f"starts again and again ({STARTS} times within {within_s:.0f} s)"
            self._tell(Hint(f"the board at {self._place} {often}: is its supply good, does its firmware fail?"))

    def _refuse(self, reason: str) -> None:
        """Each reason is told once until the board is ready, for one that is asked again refuses again."""
        self._lose()
        self._refused = reason
        if reason != self._told:
            self._told = reason
            self._tell(Gone(reason))

    def _complain(self, refusal: NotDone) -> None:
        """A board that does not take its configuration cannot be used; other refusals are counted."""
        if refusal.command == link.CONFIG:
            why = _REASONS.get(refusal.reason, f"reason {refusal.reason}")
            self._refuse(f"the board at {self._place} refuses its configuration: {why}")
        else:
            self.counters["refused-command"] += 1

    def _configure(self) -> None:
        self._say(self._writer.config(self._delays.tx_ticks, self._delays.rx_ticks))
        self._say(self._writer.ask(link.RX_ON))

    def _learn(self, status: Status, host_s: float) -> None:
        if self.status is not None:
            self._count("rx-error", max(status.errors - self.status.errors, 0))
        self.status = status
        if self._refused:
            return
        if not status.receiving:
            if self.ready:  # it has started anew
                if (
                    not self._starts or host_s - self._starts[-1] > ANSWER_S
                ):  # and its HELLO was lost, or taken for an answer
                    self._note_start(host_s)
                self._lose()
                self._configure()
            return
        if not self.ready:
            self.clock.forget()
        self.clock.hear(status.ticks, host_s)
        if not self.ready:
            self.ready, self._told = True, ""
            self._idle_polls, self._told_idle = 0, False
            self._tell(Restarted())

    def _lose(self) -> None:
        self.ready = False
        self._pending.clear()
        self.clock.forget()

    def _say(self, length: int) -> None:
        self._send(bytes(self._writer.line[:length]))
