"""A radio on a board that is connected by the serial link (``docs/serial.md``)."""

import asyncio
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air.frame import Reception, Transmission
from skyless.core.errors import SkylessError
from skyless.core.ticks import wrap
from skyless.radio.interface import (
    NOTABLE_SHARE,
    AntennaDelays,
    Gone,
    Hint,
    Late,
    Listener,
    RadioEvent,
    Restarted,
    Sent,
    ignore,
)
from skyless.radio.serial import link
from skyless.radio.serial.link import (
    BAUDS,
    MODES,
    OUTPUTS,
    Done,
    Hello,
    NotDone,
    Record,
    Status,
    TagConfig,
    Test,
    TooLate,
    Value,
    decode,
    pack,
    start_failure,
)
from skyless.radio.serial.serial_port import BoardClock, SerialPort
from skyless.radio.tag_reports import Reported

STATUS_S: Final = 0.5
"""Interval for requesting a board's state."""
BOARD_SILENCE_S: Final = 3.0
"""A board silent for this time has gone."""
MAX_PENDING_FRAMES: Final = 16
"""Frames whose end the board has not reported; it holds one, so answers about older ones were lost on the line."""

_HELLO_ANSWER_S: Final = 1.0
"""A HELLO later than this after ASK_HELLO is no answer to it: the board has started."""
_IDLE_S: Final = 5.0
"""A board that does not receive this long after its configuration will not."""
_MAX_STARTS: Final = 3
_MAX_STARTS_S: Final = 60.0
"""A board that starts as often within this time does so unintentionally."""

_LEAD_S: Final = 2.7e-3
_LEAD_BITS: Final = 2300
"""The board (0.3 ms) and a USB bridge that passes on 64 bytes in a millisecond; and on the line a command of 112 bytes,
and a record of 117, whose transfer the estimate of the board's counter lags: 5 ms at 1 Mbaud. Without such a bridge
half of it would do (``benchmarks/firmware.py site``)."""

_LINE_S: Final = 10.0
_LINE_POLLS: Final = 6
_MIN_SPOILT: Final = 3
"""The line is judged by the records of this time at most; after this number of polls, and spoilt records, at least."""
_SETTLED_S: Final = 4.0
"""A status that is older says nothing of the records that are missing now."""
SPOILT_SHARE: Final = 0.1
"""From this share of spoilt records on a line is as good as none; from ``NOTABLE_SHARE`` on it is reported."""

_REASONS: Final = {
    link.REFUSED_SETTING: "it has not these settings",
    link.REFUSED_MALFORMED: "it did not understand it",
    link.REFUSED_RADIO: "its radio does not answer or start",
}
_RESET_CAUSES: Final = {
    link.RESET_BY_FAULT: "a fault that its firmware noticed",
    link.RESET_BY_LOCKUP: "a lockup of its processor",
    link.RESET_BY_WATCHDOG: "its watchdog",
    link.RESET_BY_SOFTWARE: "its firmware",
    link.RESET_BY_PIN: "its reset pin",
}


class Computing(Struct, frozen=True):
    """How a host configures a board that is a tag by itself."""

    changes: Mapping[str, Any]
    """Settings to change, by name; the others stay."""
    keeps: bool
    """Whether to store them in flash."""


UNTIL_NEXT_START: Final = Computing({"mode": MODES.index("tag"), "output": OUTPUTS.index("records")}, keeps=False)
"""A tag that sends records to its host, until its next start."""


class LineQuality:
    """Shares of spoilt records on the line from a board."""

    def __init__(self) -> None:
        self.intact = self.spoilt = self.unsent = 0
        """Records since the session began, by the gaps in their numbers; unsent ones had no room on the line."""
        self._settled = (0, 0)
        self._before: deque[tuple[int, int]] = deque([(0, 0)], maxlen=round(_LINE_S / STATUS_S))
        self._reported = 0.0

    def settle(self, unsent: int) -> None:
        """The board has said how many of the missing records it has not sent since it last did."""
        self.unsent, self.spoilt = self.unsent + unsent, self.spoilt - unsent
        self._settled = self.intact, self.spoilt

    def worse_share(self, *, is_settled: bool) -> float | None:
        """The share of the last seconds, if it should be reported: for the first time, or because it is much worse now.

        ``is_settled``: count until the board's last status only, as later records may be missing for lack of room.
        """
        now = self._settled if is_settled else (self.intact, self.spoilt)
        intact, spoilt = now[0] - self._before[0][0], max(now[1] - self._before[0][1], 0)
        self._before.append(now)
        share = spoilt / max(intact + spoilt, 1)
        least = max(SPOILT_SHARE, 2.0 * self._reported) if self._reported else NOTABLE_SHARE
        if len(self._before) < _LINE_POLLS or spoilt < _MIN_SPOILT or share < least:
            return None
        self._reported = share
        return share

    @property
    def share(self) -> float:
        """The share since the session began."""
        return max(self.spoilt, 0) / max(self.intact + self.spoilt, 1)


class LinkSession:
    """The link to one board from the opening of its port. No I/O, no clock."""

    def __init__(
        self,
        port: str,
        delays: AntennaDelays,
        send: Callable[[bytes], None],
        listener: Listener,
        counters: Counter[str],
        *,
        transmits: bool = False,
        phases: bool = False,
        computing: Computing | None = None,
    ) -> None:
        """``port``: its name in messages; ``transmits``: refuse a board that only listens.

        ``phases``: request carrier phases from a board that has them; ``computing``: the board is a tag by itself.
        """
        self.clock = BoardClock()
        self.ready = False
        self.hello: Hello | None = None
        self.status: Status | None = None
        """The newest one."""
        self.tag_config: TagConfig | None = None
        """The last stated settings of a board that computes."""
        self.counters = counters
        self.line = LineQuality()
        self._port, self._delays, self._send, self._listener = port, delays, send, listener
        self._transmits, self._phases, self._computing = transmits, phases, computing
        self._reader, self._writer = link.Reader(), link.Writer()
        self._expected: int | None = None
        """Number of the next record."""
        self._pending: dict[int, int] = {}
        """dx and RMARKER of frames whose end the board has not reported."""
        self.heard_bytes = 0
        self._refused = self._reported = ""
        self._heard_s = self._asked_s = self._status_s = 0.0
        self._starts: deque[float] = deque(maxlen=_MAX_STARTS)
        self._hinted: set[str] = set()
        """Subjects of the hints that have been given."""
        self._idle_polls = 0

    def begin(self, host_s: float) -> None:
        """Request the board's HELLO."""
        self._heard_s = host_s
        self._send(b"\0")
        self._ask_hello(host_s)

    def poll(self, host_s: float, unheard_s: float = BOARD_SILENCE_S) -> str | None:
        """Call every ``STATUS_S``. Returns the reason to reopen the port, or None.

        ``unheard_s``: how long to wait for a board that was never heard.
        """
        if host_s - self._heard_s > (BOARD_SILENCE_S if self.line.intact else unheard_s):
            return self._reason_of_silence()
        share = self.line.worse_share(is_settled=host_s - self._status_s < _SETTLED_S)
        if share is not None:
            self._listener(Hint(spoilt_line(self._port, share)))
        if self.hello is None or self._refused:
            self._ask_hello(host_s)
        elif self.ready:
            self._send(self._writer.record(link.ASK_STATUS))
        else:
            self._configure()
            self._idle_polls += 1
            if self._idle_polls * STATUS_S >= _IDLE_S:
                why = f"the board at {self._port} answers, but does not start to receive: does its radio work?"
                self._hint_once("idle", why)
        return None

    def _hint_once(self, subject: str, text: str) -> None:
        if subject not in self._hinted:
            self._hinted.add(subject)
            self._listener(Hint(text))

    def _ask_hello(self, host_s: float) -> None:
        self._asked_s = host_s
        self._send(self._writer.ask_hello())

    def _reason_of_silence(self) -> str:
        if self.hello is not None:
            return f"the board at {self._port} has stopped answering"
        if self.line.intact:
            return f"the board at {self._port} sends records, but does not answer: does it get what is sent to it?"
        if self.heard_bytes:
            what = f"what comes from {self._port} is no serial link of Skyless"
            return f"{what} ({self.heard_bytes} bytes); wrong baud rate?"
        return f"no board answers at {self._port}"

    def transmit(self, transmission: Transmission) -> None:
        """Send a frame; it is late if no board is ready."""
        if not self.ready:
            self._listener(Late(transmission.tx_ticks))
            return
        dx_ticks = wrap(transmission.tx_ticks - self._delays.tx_ticks)
        self._pending[dx_ticks] = transmission.tx_ticks
        if len(self._pending) > MAX_PENDING_FRAMES:
            del self._pending[next(iter(self._pending))]
        self._send(self._writer.tx_at(dx_ticks, transmission.frame))

    def on_data(self, data: bytes, host_s: float) -> None:
        """Process bytes from the port."""
        self.heard_bytes += len(data)
        reader, line = self._reader, self.line
        before, spoilt = reader.garbled + reader.overlong, line.spoilt
        for record in reader.read(data):
            line.intact += 1
            self._on_record(record, host_s)
        garbled = reader.garbled + reader.overlong - before
        self._count("garbled-record", garbled)
        if self.hello is None:  # later their numbers show all that are missing
            line.spoilt = spoilt + garbled

    def _on_record(self, raw: bytes, host_s: float) -> None:
        record = decode(raw)
        if isinstance(record, Hello):
            self._expected = None
        elif self.hello is None:
            return  # from before this session
        if not self._is_next(raw[1]):
            return
        if isinstance(record, str):
            self.counters[record] += 1
            return
        self._heard_s = host_s
        self._process(record, host_s)

    def _is_next(self, number: int) -> bool:
        """Count records missing before this one. Returns False for a copy of the previous one."""
        missing = 0 if self._expected is None else (number - self._expected) & 0xFF
        if missing == 0xFF:
            self.counters["copied-record"] += 1
            return False
        self._expected = (number + 1) & 0xFF
        self._count("lost-record", missing)
        self.line.spoilt += missing
        return True

    def _count(self, reason: str, times: int) -> None:
        if times:
            self.counters[reason] += times

    def _process(self, record: Record, host_s: float) -> None:
        if isinstance(record, Reception):
            if self.ready:
                self.clock.update(record.rx_ticks, host_s)
                self._listener(replace(record, host_s=host_s))
        elif isinstance(record, Done):
            self._on_sent(record)
        elif isinstance(record, TooLate):
            tx_ticks = self._pending.pop(record.dx_ticks, None)
            if tx_ticks is not None:
                self._listener(Late(tx_ticks))
        elif isinstance(record, Status):
            self._on_status(record, host_s)
        elif isinstance(record, Hello):
            self._on_hello(record, host_s)
        elif isinstance(record, NotDone):
            self._on_refusal(record)
        elif self._computing is None or isinstance(record, Value | Test):
            pass  # of a tag, or for skyless selftest
        elif isinstance(record, TagConfig):
            self._on_tag_config(record, self._computing)
        elif self.ready:
            self._listener(Reported(record, host_s))

    def _on_sent(self, record: Done) -> None:
        tx_ticks = self._pending.pop(record.dx_ticks, None)
        if tx_ticks is None:
            return
        if record.tx_ticks != tx_ticks:
            self.counters["sent-at-another-time"] += 1
        self._listener(Sent(tx_ticks))

    def _on_hello(self, hello: Hello, host_s: float) -> None:
        """Configure a board of this version; after a repeated HELLO its status shows whether it has restarted."""
        if self.hello is not None and host_s - self._asked_s > _HELLO_ANSWER_S:
            self._count_start(host_s, hello.reset_cause)
            self.ready = self.ready and self._computing is None  # others say by their status that they have restarted
        is_repeated, self.hello = self.hello is not None and not self._refused, hello
        if hello.major != link.MAJOR:
            self._refuse(
                f"the board at {self._port} has version {hello.major}.{hello.minor} of the serial link, this "
                f"program {link.MAJOR}.{link.MINOR}; bring the board's firmware and Skyless to the same release"
            )
        elif hello.rate_khz != link.RATE_KHZ or hello.counter_bits != link.COUNTER_BITS:
            self._refuse(
                f"the board at {self._port} counts {hello.rate_khz} kHz in {hello.counter_bits} bits, not "
                f"{link.RATE_KHZ} in {link.COUNTER_BITS}: its radio is none that Skyless knows"
            )
        elif self._transmits and not hello.can_transmit:
            self._refuse(f"the board at {self._port} only listens; an anchor needs one that can transmit")
        elif self._computing is not None and not hello.can_compute:
            self._refuse(
                f"the board at {self._port} computes no positions; it needs the firmware of this release of Skyless"
            )
        else:
            self._refused = ""
            if is_repeated and self._computing is None:
                self._send(self._writer.record(link.ASK_STATUS))
            else:
                self._configure()

    def _count_start(self, host_s: float, cause: int | None) -> None:
        """Count a restart, and report once if they are frequent.

        ``cause``: as stated by the board, None if it stated none.
        """
        self.counters["board-restart"] += 1
        self._idle_polls = 0
        starts = self._starts
        if starts and host_s - starts[-1] > _MAX_STARTS_S:
            self._hinted.discard("starts")
        starts.append(host_s)
        within_s = host_s - starts[0]
        if len(starts) == _MAX_STARTS and within_s <= _MAX_STARTS_S:
            often = f"starts again and again ({_MAX_STARTS} times within {within_s:.0f} s{_last_cause(cause)})"
            why = f"the board at {self._port} {often}: is its supply good, does its firmware fail?"
            self._hint_once("starts", why)

    def _refuse(self, reason: str) -> None:
        """Report a reason once until the board is ready, as a board that is asked again refuses again."""
        self._reset()
        self._refused = reason
        if reason != self._reported:
            self._reported = reason
            self._listener(Gone(reason))

    def _on_refusal(self, refusal: NotDone) -> None:
        """A board that refuses its configuration is unusable; other refusals are counted."""
        if refusal.command in (link.CONFIG, link.SET_TAG_CONFIG):
            why = _REASONS.get(refusal.reason, f"reason {refusal.reason}")
            if refusal.start_step is not None:
                why = start_failure(refusal.start_step, refusal.identifier)
            self._refuse(f"the board at {self._port} refuses its configuration: {why}")
        else:
            self.counters["refused-command"] += 1

    def _configure(self) -> None:
        if self._computing is not None:
            self._send(self._writer.record(link.SET_TIME, (time.time_ns() // 1000).to_bytes(8, "little")))
            self._send(self._writer.record(link.ASK_TAG_CONFIG))
            self.tag_config = None
            return
        asks = self._phases and self.hello is not None and self.hello.has_phases
        flags = link.WANTS_PHASES if asks else 0
        self._send(self._writer.config(self._delays.tx_ticks, self._delays.rx_ticks, flags))
        self._send(self._writer.record(link.RX_ON))

    def _on_tag_config(self, config: TagConfig, computing: Computing) -> None:
        """Request the changes once; the answer makes the board ready."""
        is_answer, self.tag_config = self.tag_config is not None, config
        wanted = replace(config.settings, **computing.changes)
        is_same = pack(wanted) == pack(config.settings) and config.in_flash >= computing.keeps
        if not is_same and not is_answer:
            self._send(self._writer.set_tag_config(wanted, keep=computing.keeps))
        elif not self.ready and not self._refused:
            self._begin_to_report()

    def _begin_to_report(self) -> None:
        self.ready, self._reported = True, ""
        self._idle_polls = 0
        self._hinted.discard("idle")
        self._listener(Restarted())

    def _on_status(self, status: Status, host_s: float) -> None:
        self._status_s = host_s
        if self.status is not None:
            self._count("rx-error", max(status.errors - self.status.errors, 0))
            self._note_unsent(max(status.unsent_records - self.status.unsent_records, 0))
        self._check_line(status, was_polled=self.status is not None and self.status.polled)
        self.status = status
        if self._refused or self._computing is not None:  # which may sleep between its fixes
            return
        if not status.receiving:
            if self.ready:  # it has restarted
                # count it, unless its HELLO did
                if not self._starts or host_s - self._starts[-1] > _HELLO_ANSWER_S:
                    self._count_start(host_s, None)
                self._reset()
                self._configure()
            return
        if not self.ready:
            self.clock.reset()
        self.clock.update(status.ticks, host_s)
        if not self.ready:
            self._begin_to_report()

    def _note_unsent(self, records: int) -> None:
        """Records without room on the line are missing like spoilt ones; report once that it is full."""
        line = self.line
        line.settle(records)
        if line.unsent > NOTABLE_SHARE * (line.intact + line.unsent) + _MIN_SPOILT:
            advice = "fewer beacons (skyless site new --board dwm1001-dev), or a higher rate (skyless flash-config)"
            self._hint_once(
                "full", f"the line from the board at {self._port} is full, and records are left out: {advice}"
            )

    def _check_line(self, status: Status, *, was_polled: bool) -> None:
        """Count when the board starts to poll its radio, and report it once."""
        if not status.polled or was_polled:
            return
        self.counters["interrupt-line-stuck"] += 1
        self._hint_once(
            "interrupt-line",
            f"the interrupt line of the radio on the board at {self._port} does not follow its events; the "
            "board polls it, and receptions may come late: is the module sound (on a DWM1001 its GPIO 19)?",
        )

    def _reset(self) -> None:
        self.ready = False
        self._pending.clear()
        self.clock.reset()


def spoilt_line(port: str, share: float) -> str:
    """What to do about a line that spoils this share of the records."""
    return (
        f"{100 * share:.0f} % of what the board at {port} says is spoilt on the line: try another cable, no hub, or a "
        f"rate of {BAUDS[0]} baud or lower (skyless flash-config --baud {BAUDS[0]})"
    )


def _last_cause(cause: int | None) -> str:
    """Cause of a board's start, for a message; empty if not stated."""
    if cause is None:
        return ""
    words = [text for bit, text in _RESET_CAUSES.items() if cause & bit]
    if cause == 0:
        words = ["power on or too low a supply"]
    return f", at last by {' and '.join(words) or f'cause {cause:#04x}'}"


class SerialRadio:
    """One node's board (``skyless.radio.interface.Radio``)."""

    def __init__(
        self,
        path: str,
        bauds: Sequence[int],
        name: str,
        delays: AntennaDelays | None = None,
        *,
        transmits: bool = False,
        phases: bool = False,
        computing: Computing | None = None,
    ) -> None:
        """``bauds``: rates at which the board is looked for; the flags are those of ``LinkSession``."""
        self.name = name
        self.counters: Counter[str] = Counter()
        self._bauds, self._tried = deque(bauds), 0
        self._reason = ""
        """Why none of the rates that were tried is the board's; one at which bytes came says most."""
        self._delays = AntennaDelays() if delays is None else delays
        self._transmits, self._phases, self._computing = transmits, phases, computing
        self._port = SerialPort(path, bauds[0], lambda reason: self._listener(Gone(reason)))
        self._listener: Listener = ignore
        self._session: LinkSession | None = None

    @property
    def lead_s(self) -> float:
        """Initial lead time of ``transmit``, at the present rate."""
        return _LEAD_S + _LEAD_BITS / self._port.baud

    @property
    def hello(self) -> Hello | None:
        """The board's HELLO; None before one has answered."""
        return None if self._session is None else self._session.hello

    @property
    def tag_config(self) -> TagConfig | None:
        """Settings of a board that computes; None before it has stated them."""
        return None if self._session is None else self._session.tag_config

    @property
    def spoilt_share(self) -> float:
        """Share of the board's records that were spoilt on the line."""
        return 0.0 if self._session is None else self._session.line.share

    async def run(self, listener: Listener) -> None:
        """Receive until cancelled; an unplugged board is searched for."""
        self._listener = listener
        poll = asyncio.ensure_future(self._poll())
        try:
            await self._port.run(self)
        finally:
            poll.cancel()
            await asyncio.gather(poll, return_exceptions=True)

    def advice(self) -> str:
        """Where to look if the board answers but receives nothing."""
        path = self._port.path
        return f"the board at {path} answers, but receives no frame: are anchors on the air, is its antenna free?"

    def now_ticks(self) -> int | None:
        """The board's counter, extrapolated from its newest stamps; None while it is not ready."""
        session = self._session
        return session.clock.read(time.monotonic()) if session is not None and session.ready else None

    def transmit(self, transmission: Transmission) -> None:
        """Send a frame; without a board it is late."""
        if self._session is None:
            self._listener(Late(transmission.tx_ticks))
        else:
            self._session.transmit(transmission)

    def _on_event(self, event: RadioEvent) -> None:
        if isinstance(event, Restarted):
            self._port.clear_report()
            self._tried = 0
        self._listener(event)

    async def _poll(self) -> None:
        while True:
            await asyncio.sleep(STATUS_S)
            if self._session is not None:
                reason = self._session.poll(time.monotonic(), BOARD_SILENCE_S / len(self._bauds))
                if reason is not None:
                    self._port.reopen(reason if self._session.line.intact else self._try_next_rate(reason))

    def _try_next_rate(self, reason: str) -> str | None:
        """Look for a silent board at the next rate. Returns why there is none when all have been tried."""
        if not self._tried or (self._session is not None and self._session.heard_bytes):
            self._reason = reason
        self._bauds.rotate(-1)
        self._port.baud = self._bauds[0]
        self._tried = (self._tried + 1) % len(self._bauds)
        if self._tried:
            return None
        rates = f" (tried {', '.join(map(str, self._bauds))} baud)" if len(self._bauds) > 1 else ""
        return self._reason + rates

    # What the port calls

    def on_open(self, send: Callable[[bytes], None]) -> None:
        """Begin a session with the board."""
        self._session = LinkSession(
            self._port.path,
            self._delays,
            send,
            self._on_event,
            self.counters,
            transmits=self._transmits,
            phases=self._phases,
            computing=self._computing,
        )
        self._session.begin(time.monotonic())

    def on_data(self, data: bytes) -> None:
        """Process bytes from the board."""
        if self._session is not None:
            self._session.on_data(data, time.monotonic())

    def on_close(self) -> None:
        """The board has gone."""
        self._session = None


# Asks a board for its settings and changes them, at whatever rate its port works.


async def set_up(path: str, bauds: Sequence[int], computing: Computing) -> TagConfig:
    """Return the settings of the board at a port, after the requested changes, if any.

    Raises:
        SkylessError: the port cannot be opened, no board answers, or it computes no positions or refuses.
    """
    radio, events = SerialRadio(path, bauds, "", computing=computing), asyncio.Queue[RadioEvent]()
    running = asyncio.ensure_future(radio.run(events.put_nowait))
    try:
        event = await events.get()
    finally:
        config = radio.tag_config
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    if isinstance(event, Gone):
        raise SkylessError(event.reason)
    if config is None:
        raise SkylessError(f"the board at {path} says no settings")
    return config
