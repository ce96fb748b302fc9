"""Measure one or two boards on serial ports: their lines, processors, chips, and the air between them."""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Sequence
from typing import Any, Final, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air.frame import Diagnostics, Reception, fcs
from skyless.core.ticks import (
    DEFAULT_ANTENNA_DELAY_TICKS,
    DELAYED_TX_GRANULARITY_TICKS,
    difference,
    from_seconds,
    wrap,
)
from skyless.core.version import installed_version
from skyless.radio.serial import link
from skyless.radio.serial.serial_port import BoardClock, SerialPort
from skyless.run.selftest.facts import (
    CHIP_HZ,
    FRAME_BYTES,
    OTP_WORDS,
    PATTERN,
    BoardFacts,
    Clocks,
    Heard,
    LineTest,
    Reading,
    Report,
)

Answer = TypeVar("Answer")


class Amounts(Struct, frozen=True):
    """How much is measured: some two minutes by default."""

    records: int = 1000
    """Of each length, at each rate, each way."""
    readings: int = 1000
    alone_frames: int = 100
    alone_s: float = 5.0
    pair_s: float = 60.0
    """For which two boards send in turns."""


LINE_BYTES: Final = (27, 117)
"""A HELLO, and a reception of a beacon."""
_BURST: Final = 8
"""Test records that are sent at once."""
_ANSWER_S: Final = 0.3
_TRIES: Final = 10
_HELLO_TRIES: Final = 4
_SET_TRIES: Final = 6
_KEEP_ALIVE_S: Final = 1.0
_DRAIN_S: Final = 0.05
"""In which the last record leaves a port."""
_TRIAL_S: Final = 3.5
"""After which a board has given up a rate at which it understood nothing."""
_LEAD_S: Final = 8e-3
_LEAD_BITS: Final = 2 * LINE_BYTES[1] * 10
"""A frame's way to the board, and on the line a command and the record by which the board's counter is known."""
_FRAME_S: Final = 7.5e-3
"""Between a frame of one board and the next of the other, at least."""
_FRAME: Final = b"\x41\x88skyless selftest"
"""The first bytes of a test frame: a data frame, which no tag takes for a beacon."""


class TroubleError(Exception):
    """The test of a board cannot go on; the message is a sentence."""


class Bench:
    """One board and its port (``serial_port.PortUser``)."""

    def __init__(self, name: str, path: str) -> None:
        self.facts = BoardFacts(name, path)
        self.port = SerialPort(path, link.BAUDS[0], self._note_trouble)
        self.can_send = False
        """Whether its chip has started."""
        self._trouble = f"There is no {path}."
        self._opened = asyncio.Event()
        self._send: Callable[[bytes], None] = lambda data: None  # noqa: ARG005 - nothing is open
        self._reader, self._writer, self._clock = link.Reader(), link.Writer(), BoardClock()
        self._wanted: tuple[type, ...] = ()
        self._answer: asyncio.Future[Any] | None = None
        self._settings = link.BoardSettings()
        self._tests: Counter[int] = Counter()
        """Records that tested the line, by their length."""
        self._pending: dict[int, int] = {}
        """Numbers of frames by their dx."""

    # What the port calls

    def _note_trouble(self, reason: str) -> None:
        self._trouble = f"{reason[:1].upper()}{reason[1:]}."

    def on_open(self, send: Callable[[bytes], None]) -> None:
        """The port is open."""
        self._send, self._reader = send, link.Reader()
        send(b"\0")
        self._opened.set()

    def on_close(self) -> None:
        """The port is closed."""
        self._opened.clear()

    def on_data(self, data: bytes) -> None:
        """Take the board's records."""
        for raw in self._reader.read(data):
            record = link.decode(raw)
            if isinstance(record, link.Test):
                self._tests[record.length] += 1
            elif isinstance(record, Reception):
                self._hear(record)
            elif isinstance(record, link.Done | link.TooLate):
                self._end_sending(record)
            elif isinstance(record, link.Status):
                self._clock.update(record.ticks, time.monotonic())
            if self._answer is not None and isinstance(record, self._wanted) and not self._answer.done():
                self._answer.set_result(record)

    def _hear(self, record: Reception) -> None:
        self._clock.update(record.rx_ticks, time.monotonic())
        if record.frame.startswith(_FRAME):
            number, measured = (
                int.from_bytes(record.frame[len(_FRAME) :][:4], "little"),
                record.diagnostics or Diagnostics(),
            )
            heard = Heard(number, record.rx_ticks, measured.rx_power_dbm, measured.carrier_offset_ppm)
            self.facts.heard.append(heard)

    def _end_sending(self, record: link.Done | link.TooLate) -> None:
        number = self._pending.pop(record.dx_ticks, None)
        if number is None:
            return
        if isinstance(record, link.TooLate):
            self.facts.late += 1
            return
        self.facts.tx_ticks[number] = record.tx_ticks
        due_ticks = wrap((record.dx_ticks & -DELAYED_TX_GRANULARITY_TICKS) + DEFAULT_ANTENNA_DELAY_TICKS)
        if record.tx_ticks != due_ticks:
            self.facts.wrong.append((number, difference(record.tx_ticks, due_ticks)))

    # To the board

    async def _ask(
        self, kind: int, body: bytes, *answers: type[Answer], tries: int = _TRIES, wait_s: float = _ANSWER_S
    ) -> Answer:
        """Ask until one of these answers comes, as lines may spoil some. Raises TroubleError."""
        for _ in range(tries):
            self._wanted, self._answer = answers, asyncio.get_running_loop().create_future()
            self._send(self._writer.record(kind, body))
            with contextlib.suppress(TimeoutError):
                found: Answer = await asyncio.wait_for(self._answer, wait_s)
                return found
        is_open = self._opened.is_set()
        raise TroubleError(f"The board at {self.facts.path} does not answer." if is_open else self._trouble)

    async def _hello_at(self, baud: int) -> link.Hello | None:
        """Open the port at a rate; the board's identity, or None if it does not answer. Raises TroubleError."""
        self._opened.clear()
        self.port.baud = baud
        self.port.reopen(None)
        try:
            await asyncio.wait_for(self._opened.wait(), 2.0)
        except TimeoutError:
            raise TroubleError(self._trouble) from None
        with contextlib.suppress(TroubleError):
            return await self._ask(link.ASK_HELLO, bytes((link.MAJOR, link.MINOR)), link.Hello, tries=_HELLO_TRIES)
        return None

    async def connect(self) -> None:
        """Find the board at one of its rates. Raises TroubleError."""
        for baud in link.BAUDS:
            hello = await self._hello_at(baud)
            if hello is not None:
                break
        else:
            raise TroubleError(f"No board of Skyless answers at {self.facts.path}: another port, or no firmware?")
        self.facts.firmware, self.facts.device_id = hello.firmware, hello.device_id.hex()
        self.facts.reset_cause, self.facts.can_transmit = hello.reset_cause or 0, hello.can_transmit
        if (hello.major, hello.minor) < (link.MAJOR, 4):
            raise TroubleError("Its firmware is too old to be tested: skyless flash brings the present one.")
        self._settings = (await self._ask(link.ASK_TAG_CONFIG, b"", link.TagConfig)).settings
        self.facts.baud = self._settings.baud
        await self._set(self._as_radio(baud))

    def _as_radio(self, baud: int) -> link.BoardSettings:
        """Its settings, but a radio at this rate: a tag would write text, compute and sleep."""
        return replace(self._settings, mode=link.MODES.index("radio"), baud=baud)

    async def _set(self, settings: link.BoardSettings) -> None:
        """Use settings until the next start; a line that spoils much may lose the answer only."""
        with contextlib.suppress(TroubleError):
            await self._ask(link.SET_TAG_CONFIG, b"\0" + link.pack(settings), link.TagConfig, tries=_SET_TRIES)

    async def _set_rate(self, baud: int) -> bool:
        """Go to another rate; False, at its own one, if the board is not understood there."""
        await self._set(self._as_radio(baud))
        if await self._hello_at(baud) is not None:
            return True
        await asyncio.sleep(_TRIAL_S)
        await self._hello_at(self.facts.baud)
        await self._set(self._as_radio(self.facts.baud))
        return False

    async def _read(self, file: int, sub: int = 0, octets: int = 4, times: int = 1, more: bytes = b"\0") -> link.Value:
        """READ; ``more`` are its flags, and what is to be written. Raises TroubleError."""
        numbers = (file, 1), (sub, 2), (octets, 1), (times, 2)
        body = b"".join(number.to_bytes(size, "little") for number, size in numbers)
        while True:
            value = await self._ask(link.READ, body + more, link.Value, wait_s=1.0)
            if (value.file, value.sub) == (file, sub):  # else it is a late answer to another question
                return value

    async def _words(self, file: int, sub: int = 0) -> list[int]:
        """A reading of words of four bytes."""
        data = (await self._read(file, sub)).data
        return [int.from_bytes(data[at : at + 4], "little") for at in range(0, len(data) - 3, 4)]

    # Steps

    async def test_line(self, baud: int, records: int) -> None:
        """Both ways at one rate; where the board is not understood all is spoilt."""
        is_there = baud == self.port.baud or await self._set_rate(baud)
        for size in LINE_BYTES:
            came = [0, 0]
            try:
                if is_there:
                    came[0] = await self._test_from_board(baud, records, size)
                    came[1] = await self._test_to_board(baud, records, size)
            except TroubleError:
                if not self._opened.is_set():
                    raise
            ways = zip((True, False), came, strict=True)
            self.facts.lines += [LineTest(baud, way, size, records, min(number, records)) for way, number in ways]

    async def _test_from_board(self, baud: int, records: int, size: int) -> int:
        """How many of the board's records come."""
        self._tests.clear()
        self._send(self._writer.record(link.TEST_LINE, records.to_bytes(2, "little") + bytes((size,))))
        ends_s = time.monotonic() + records * size * 10.5 / baud + 4 * _ANSWER_S
        while self._tests[size] < records and time.monotonic() < ends_s:
            await asyncio.sleep(0.02)
        return self._tests[size]

    async def _test_to_board(self, baud: int, records: int, size: int) -> int:
        """How many records the board gets."""
        body = bytes((0, 0, size)) + bytes(range(256 - size + link.TEST_OVERHEAD + 3, 256))
        before = (await self._words(link.COUNTS))[4]
        for at in range(0, records, _BURST):
            number = min(_BURST, records - at)
            self._send(b"".join(self._writer.record(link.TEST_LINE, body) for _ in range(number)))
            await asyncio.sleep(number * size * 10.5 / baud)
        await asyncio.sleep(_ANSWER_S)
        return (await self._words(link.COUNTS))[4] - before

    async def use_cleanest_rate(self) -> None:
        """Stay at the board's own rate if it is clean, or go to the one that spoils least."""
        least = {baud: min(one.came for one in self.facts.lines if one.baud == baud) for baud in link.BAUDS}
        best = max(link.BAUDS, key=lambda baud: (least[baud], baud == self.facts.baud, baud))
        if best != self.port.baud:
            await self._set_rate(best)

    async def test_chip(self, times: int) -> None:
        """Processor, identifier, a pattern and the factory's data."""
        found = self.facts
        part, variant, revision, pin, lock, stack, used = (await self._words(link.FACTS))[:7]
        found.processor = part, variant, revision, pin, lock, stack, used
        config = link.unstuff(self._writer.config(DEFAULT_ANTENNA_DELAY_TICKS, DEFAULT_ANTENNA_DELAY_TICKS)[:-1])
        assert config is not None
        answer = await self._ask(link.CONFIG, config[2:-2], link.Status, link.NotDone, wait_s=1.0)
        found.start_step = answer.start_step if isinstance(answer, link.NotDone) else None
        has_started = found.start_step is None
        for hz in CHIP_HZ if has_started else CHIP_HZ[:1]:
            flags = bytes((link.READ_SLOWLY if hz == CHIP_HZ[0] else 0,))
            one = await self._read(0x00, times=times, more=flags)
            found.readings.append(_reading(hz, link.DEVICE_ID.to_bytes(4, "little"), one, times))
            if has_started:
                one = await self._read(0x03, 0, len(PATTERN), times, flags + PATTERN)
                found.readings.append(_reading(hz, PATTERN, one, times))
        if has_started:
            found.otp = {name: (await self._words(link.OTP, address))[0] for name, address in OTP_WORDS.items()}
        self.can_send = has_started

    async def keep_alive(self) -> None:
        """Let the board understand a record, or it would give up a rate that its flash does not hold."""
        await self._ask(link.ASK_STATUS, b"", link.Status)

    @property
    def lead_s(self) -> float:
        """How early a frame is handed over; a board holds one, so its next must not come before it has left."""
        return _LEAD_S + _LEAD_BITS / self.port.baud

    async def begin_frames(self) -> None:
        """Read all clocks at once, and turn the receiver on."""
        await self._read_clocks()
        self._clock.reset()
        await self._ask(link.RX_ON, b"", link.Status)

    async def _read_clocks(self) -> None:
        data = (await self._read(link.CLOCKS)).data
        us, slow, ticks = (int.from_bytes(data[at:end], "little") for at, end in ((0, 4), (4, 8), (8, 13)))
        self.facts.clocks.append(Clocks(us, slow, ticks))

    def send_frame(self, number: int) -> None:
        """Send a numbered frame after the lead."""
        now_ticks = self._clock.read(time.monotonic())
        if now_ticks is None or not self.facts.can_transmit:
            return
        body = _FRAME + number.to_bytes(4, "little") + bytes(range(FRAME_BYTES - len(_FRAME) - 6))
        dx_ticks = wrap(now_ticks + from_seconds(self.lead_s))
        self._pending[dx_ticks] = number
        self.facts.asked += 1
        self._send(self._writer.tx_at(dx_ticks, body + fcs(body)))

    async def finish(self) -> None:
        """What was counted and measured meanwhile."""
        await self._read_clocks()
        lock_us, clock, carrier, reception_us, tested = (await self._words(link.COUNTS))[:5]
        self.facts.counts = lock_us, clock, carrier, reception_us, tested
        status = await self._ask(link.ASK_STATUS, b"", link.Status)
        self.facts.temperature_c, self.facts.supply_v = status.temperature_c, status.supply_v

    def restore(self) -> None:
        """Let the board have its own settings again, without waiting for its answer."""
        if self.facts.baud:
            self._send(self._writer.record(link.SET_TAG_CONFIG, b"\0" + link.pack(self._settings)))


def _reading(hz: int, expected: bytes, value: link.Value, times: int) -> Reading:
    """With the digits of a number, highest first."""
    return Reading(hz, expected[::-1].hex().upper(), value.data[::-1].hex().upper(), times, value.differing)


def report_of(benches: Sequence[Bench], distance_m: float | None) -> Report:
    """What was found so far; the distance is that between the antennas of two boards."""
    return Report(installed_version(), time.strftime("%Y-%m-%d %H:%M"), distance_m, [one.facts for one in benches])


async def measure(
    benches: Sequence[Bench],
    amounts: Amounts | None = None,
    reach: Callable[[str], None] = lambda step: None,  # noqa: ARG005
) -> None:
    """Test each board alone, then two of them together. ``reach`` is called at the start of each step."""
    amounts = amounts or Amounts()
    running = [asyncio.ensure_future(bench.port.run(bench)) for bench in benches]
    unfinished = set(benches)
    try:
        await asyncio.gather(*(_guarded(bench, _test_alone(bench, amounts, reach, unfinished)) for bench in benches))
        await _send_frames([one for one in benches if one.can_send], amounts, reach)
    finally:
        for bench in benches:
            bench.restore()
        await asyncio.sleep(_DRAIN_S)
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)


async def _guarded(bench: Bench, step: Coroutine[Any, Any, None]) -> None:
    """Note the trouble of a step, in which the board cannot go on."""
    try:
        await step
    except TroubleError as error:
        bench.facts.trouble, bench.can_send = str(error), False


async def _test_alone(bench: Bench, amounts: Amounts, reach: Callable[[str], None], unfinished: set[Bench]) -> None:
    """Line, processor and chip; then wait for the boards that are unfinished."""
    name = bench.facts.name
    try:
        reach(f"{name}: connecting")
        await bench.connect()
        for baud in sorted(link.BAUDS):
            reach(f"{name}: line at {baud:,} baud")
            await bench.test_line(baud, amounts.records)
        await bench.use_cleanest_rate()
        reach(f"{name}: processor and chip")
        await bench.test_chip(amounts.readings)
    finally:
        unfinished.discard(bench)
    while unfinished:
        await bench.keep_alive()
        await asyncio.sleep(_KEEP_ALIVE_S)


async def _send_frames(benches: Sequence[Bench], amounts: Amounts, reach: Callable[[str], None]) -> None:
    """Let two boards send in turns from the moment that they receive, or one alone."""
    if not benches:
        return
    seconds = amounts.pair_s if len(benches) > 1 else amounts.alone_s
    slowest_s = max(_FRAME_S, 0.6 * max(bench.lead_s for bench in benches))
    period_s = slowest_s if len(benches) > 1 else seconds / amounts.alone_frames
    reach(f"{' and '.join(one.facts.name for one in benches)}: frames for {seconds:.0f} s")
    await asyncio.gather(*(_guarded(bench, bench.begin_frames()) for bench in benches))
    began_s = time.monotonic()
    for number in range(round(seconds / period_s)):
        await asyncio.sleep(max(began_s + number * period_s - time.monotonic(), 0.0))
        benches[number % len(benches)].send_frame(number)
    await asyncio.sleep(_ANSWER_S)
    await asyncio.gather(*(_guarded(bench, bench.finish()) for bench in benches))
