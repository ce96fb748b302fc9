"""Measure one or two boards on serial ports: their lines, processors, chips, and the air between them."""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Any, Final, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air.frame import fcs
from skyless.core.ticks import DEFAULT_ANTENNA_DELAY_TICKS, DELAYED_TX_GRANULARITY_TICKS, from_seconds, wrap
from skyless.core.version import installed_version
from skyless.radio.serial import link
from skyless.radio.serial.link import (
    BAUDS,
    BoardSettings,
    Done,
    Heard,
    Hello,
    NotDone,
    Status,
    TagConfig,
    TooLate,
    Value,
)
from skyless.radio.serial.serial_port import BoardClock, SerialPort
from skyless.run.selftest import facts
from skyless.run.selftest.facts import BoardFacts, Clocks, LineTest, Reading, Report

Answer = TypeVar("Answer")


class Amounts(Struct, frozen=True):
    """How much is measured: some two minutes by default."""

    records: int = 1000
    """Of each length, at each rate, each way."""
    readings: int = 1000
    alone_frames: int = 100
    pair_s: float = 60.0
    """For which two boards send in turns."""
    clocks_s: float = 5.0


LINE_BYTES: Final = (27, 117)
"""A HELLO, and a reception of a beacon."""
_ANSWER_S: Final = 0.3
_TRIES: Final = 10
_HELLO_TRIES: Final = 4
_TRIAL_S: Final = 3.5
"""After which a board has given up a rate at which it understood nothing."""
_LEAD_S: Final = 12e-3
_FRAME_S: Final = 7.5e-3
"""Between a frame of one board and the next of the other; a board holds one, so its next must not come before it left."""
_BURST: Final = 8
"""Test records that are sent at once."""


class TroubleError(Exception):
    """The test of a board cannot go on; the message is a sentence."""


class Bench:
    """One board and its port (``serial_port.PortUser``)."""

    def __init__(self, name: str, path: str, make_port: Callable[..., SerialPort] = SerialPort) -> None:
        self.facts = BoardFacts(name, path)
        self.clock = BoardClock()
        self.tests: Counter[int] = Counter()
        """Records that tested the line, by their length."""
        self.settings = BoardSettings()
        self._wanted: tuple[type, ...] = ()
        self._answer: asyncio.Future[Any] | None = None
        self._reader, self._writer = link.Reader(), link.Writer()
        self._trouble = f"There is no {path}."
        self._port = make_port(path, BAUDS[0], self._note)
        self._opened = asyncio.Event()
        self._send: Callable[[bytes], None] = lambda data: None  # noqa: ARG005 - nothing is open
        self._pending: dict[int, int] = {}
        """Frames by their dx."""

    def _note(self, reason: str) -> None:
        self._trouble = f"{reason[:1].upper()}{reason[1:]}."

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Hold the port open."""
        running = asyncio.ensure_future(self._port.run(self))
        try:
            yield
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    # What the port calls

    def on_open(self, send: Callable[[bytes], None]) -> None:
        """The port is open."""
        self._send = send
        self._reader = link.Reader()
        send(b"\0")
        self._opened.set()

    def on_close(self) -> None:
        """The port is closed."""
        self._opened.clear()

    def on_data(self, data: bytes) -> None:
        """Take the board's records."""
        now_s = time.monotonic()
        for raw in self._reader.read(data):
            record = link.decode(raw)
            if isinstance(record, link.Test):
                self.tests[record.length] += 1
            elif isinstance(record, Heard):
                self._hear(record, now_s)
            elif isinstance(record, Done | TooLate):
                self._end_sending(record)
            elif isinstance(record, Status):
                self.clock.update(record.ticks, now_s)
            if self._answer is not None and isinstance(record, self._wanted) and not self._answer.done():
                self._answer.set_result(record)

    def _hear(self, record: Heard, now_s: float) -> None:
        self.clock.update(record.rx_ticks, now_s)
        number = frame_number(record.frame)
        measured = record.diagnostics
        if number is not None:
            self.facts.heard.append(
                facts.Heard(number, record.rx_ticks, measured.rx_power_dbm, measured.carrier_offset_ppm)
            )

    def _end_sending(self, record: Done | TooLate) -> None:
        number, sending = self._pending.pop(record.dx_ticks, None), self.facts.sending
        if number is None:
            return
        if isinstance(record, TooLate):
            sending.late += 1
            return
        sending.tx_ticks[number] = record.tx_ticks
        at_ticks = wrap((record.dx_ticks & -DELAYED_TX_GRANULARITY_TICKS) + DEFAULT_ANTENNA_DELAY_TICKS)
        if record.tx_ticks != at_ticks:
            off = (record.tx_ticks - at_ticks + (1 << 39)) % (1 << 40) - (1 << 39)
            sending.wrong.append((number, off))

    # To the board

    async def ask(
        self, kind: int, body: bytes, *answers: type[Answer], tries: int = _TRIES, wait_s: float = _ANSWER_S
    ) -> Answer:
        """Ask until one of these answers comes, as lines may spoil some. Raises TroubleError."""
        for _ in range(tries):
            self._wanted, self._answer = answers, asyncio.get_running_loop().create_future()
            self._send(self._writer.record(kind, body))
            with contextlib.suppress(TimeoutError):
                found: Answer = await asyncio.wait_for(self._answer, wait_s)
                return found
        raise TroubleError(f"The board at {self.facts.path} does not answer.")

    async def at_rate(self, baud: int) -> None:
        """Open the port at a rate. Raises TroubleError."""
        self._opened.clear()
        self._port.baud = baud
        self._port.reopen(None)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._opened.wait(), 2.0)
            return
        raise TroubleError(self._trouble)

    async def hello(self) -> Hello | None:
        """The board's identity; None if it does not answer at this rate."""
        with contextlib.suppress(TroubleError):
            return await self.ask(link.ASK_HELLO, bytes((link.MAJOR, link.MINOR)), Hello, tries=_HELLO_TRIES)
        return None

    async def connect(self) -> None:
        """Find the board at one of its rates. Raises TroubleError."""
        for baud in BAUDS:
            await self.at_rate(baud)
            hello = await self.hello()
            if hello is not None:
                break
        else:
            raise TroubleError(f"No board of Skyless answers at {self.facts.path}: another port, or no firmware?")
        self.facts.firmware, self.facts.device_id = hello.firmware, hello.device_id.hex()
        self.facts.reset_cause = hello.reset_cause
        if (hello.major, hello.minor) < (link.MAJOR, 4):
            raise TroubleError("Its firmware is too old to be tested: skyless flash brings the present one.")
        self.settings = replace((await self.ask(link.ASK_TAG_CONFIG, b"", TagConfig)).settings, mode=0)
        self.facts.baud = self.settings.baud

    async def set_rate(self, baud: int) -> bool:
        """Go to another rate until the next start; False, at the old one, if the board is not understood there."""
        wanted = replace(self.settings, baud=baud)
        with contextlib.suppress(TroubleError):  # a line that spoils much may have lost the answer only
            await self.ask(link.SET_TAG_CONFIG, b"\0" + link.pack(wanted), TagConfig, tries=_HELLO_TRIES)
        await self.at_rate(baud)
        if await self.hello() is not None:
            return True
        await asyncio.sleep(_TRIAL_S)
        await self.at_rate(self.facts.baud)
        return False

    async def read(
        self, file: int, sub: int = 0, octets: int = 4, times: int = 1, *, slowly: bool = False, data: bytes = b""
    ) -> Value:
        """READ. Raises TroubleError."""
        body = bytes((file,)) + sub.to_bytes(2, "little") + bytes((octets,)) + times.to_bytes(2, "little")
        return await self.ask(link.READ, body + bytes((slowly * link.READ_SLOWLY,)) + data, Value, wait_s=1.0)

    async def words(self, file: int, sub: int = 0) -> list[int]:
        """A reading of words of four bytes."""
        data = (await self.read(file, sub)).data
        return [int.from_bytes(data[at : at + 4], "little") for at in range(0, len(data) - 3, 4)]

    # Steps

    async def test_line(self, baud: int, records: int) -> None:
        """Both ways at one rate, to which the port is set; rates that say nothing count as spoilt."""
        is_there = baud == self._port.baud or await self.set_rate(baud)
        for size in LINE_BYTES:
            came = [0, 0]
            with contextlib.suppress(TroubleError):
                if is_there:
                    came[0] = await self._test_from_board(baud, records, size)
                    came[1] = await self._test_to_board(baud, records, size)
            for from_board, number in ((True, came[0]), (False, came[1])):
                self.facts.lines.append(LineTest(baud, from_board, size, records, min(number, records)))

    async def _test_from_board(self, baud: int, records: int, size: int) -> int:
        """How many of the board's records come."""
        self.tests.clear()
        self._send(self._writer.record(link.TEST_LINE, records.to_bytes(2, "little") + bytes((size,))))
        ends_s = time.monotonic() + records * size * 10.5 / baud + 4 * _ANSWER_S
        while self.tests[size] < records and time.monotonic() < ends_s:
            await asyncio.sleep(0.02)
        return self.tests[size]

    async def _test_to_board(self, baud: int, records: int, size: int) -> int:
        """How many records the board gets."""
        test = bytes((0, 0, size)) + bytes(range(256 - size + link.TEST_OVERHEAD + 3, 256))
        before = (await self.words(link.COUNTS))[4]
        for at in range(0, records, _BURST):
            number = min(_BURST, records - at)
            self._send(b"".join(self._writer.record(link.TEST_LINE, test) for _ in range(number)))
            await asyncio.sleep(number * size * 10.5 / baud)
        await asyncio.sleep(_ANSWER_S)
        return (await self.words(link.COUNTS))[4] - before

    async def use_cleanest_rate(self) -> None:
        """Stay at the board's own rate if it is clean, or go to the one that spoils least."""
        least = {baud: min(one.came for one in self.facts.lines if one.baud == baud) for baud in BAUDS}
        best = max(BAUDS, key=lambda baud: (least[baud], baud == self.facts.baud, baud))
        if best != self._port.baud:
            await self.set_rate(best)

    async def test_chip(self, amounts: Amounts) -> bool:
        """Processor, identifier, a pattern and the factory's data; whether the chip has started."""
        found, times = self.facts, amounts.readings
        found.processor = await self.words(link.FACTS)
        delays = DEFAULT_ANTENNA_DELAY_TICKS, DEFAULT_ANTENNA_DELAY_TICKS
        answer = await self.ask(link.CONFIG, _body(self._writer.config(*delays)), Status, NotDone, wait_s=1.0)
        found.start_step = answer.start_step if isinstance(answer, NotDone) else None
        for hz in facts.CHIP_HZ[: 1 if found.start_step else 2]:
            slowly = hz == facts.CHIP_HZ[0]
            one = await self.read(0x00, times=times, slowly=slowly)
            expected, shown = f"{link.DEVICE_ID:08X}", one.data[::-1].hex().upper()
            found.identifiers.append(Reading(hz, expected, shown, times, one.differing))
            if found.start_step is None:
                one = await self.read(0x03, 0, len(facts.PATTERN), times, slowly=slowly, data=facts.PATTERN)
                shown = one.data.hex().upper()
                found.patterns.append(Reading(hz, facts.PATTERN.hex().upper(), shown, times, one.differing))
        if found.start_step is None:
            for name, address in facts.OTP_WORDS.items():
                found.otp[name] = (await self.words(link.OTP, address))[0]
        return found.start_step is None

    async def note_clocks(self) -> None:
        """Read all clocks at once."""
        data = (await self.read(link.CLOCKS)).data
        us, slow, ticks = (int.from_bytes(data[at:end], "little") for at, end in ((0, 4), (4, 8), (8, 13)))
        self.facts.clocks.append(Clocks(us, slow, ticks))

    async def receive(self) -> None:
        """Turn the receiver on."""
        self.clock.reset()
        await self.ask(link.RX_ON, b"", Status)

    def send_frame(self, number: int) -> None:
        """Send a numbered frame some milliseconds from now."""
        now_ticks = self.clock.read(time.monotonic())
        if now_ticks is None:
            return
        body = _FRAME + number.to_bytes(4, "little") + bytes(range(facts.FRAME_BYTES - len(_FRAME) - 6))
        dx_ticks = wrap(now_ticks + from_seconds(_LEAD_S))
        self._pending[dx_ticks] = number
        self.facts.sending.asked += 1
        self._send(self._writer.tx_at(dx_ticks, body + fcs(body)))

    async def finish(self) -> None:
        """What has been counted and measured meanwhile; then the board is as it was."""
        await self.note_clocks()
        self.facts.counts = await self.words(link.COUNTS)
        status = await self.ask(link.ASK_STATUS, b"", Status)
        self.facts.temperature_c, self.facts.supply_v = status.temperature_c, status.supply_v


_FRAME: Final = b"\x41\x88skyless selftest"
"""The begin of a test frame: a data frame that no tag takes for a beacon."""


def frame_number(frame: bytes) -> int | None:
    """The number of a test frame; None for others."""
    at = len(_FRAME)
    return int.from_bytes(frame[at : at + 4], "little") if frame.startswith(_FRAME) else None


def _body(line: bytes) -> bytes:
    record = link.unstuff(line[:-1])
    assert record is not None
    return record[2:-2]


async def measure(
    benches: Sequence[Bench],
    distance_m: float | None = None,
    amounts: Amounts | None = None,
    reach: Callable[[str], None] = lambda step: None,  # noqa: ARG005
) -> Report:
    """Test boards one after the other, then two of them together. ``reach`` is called at the begin of each step."""
    amounts = amounts or Amounts()
    report = Report(installed_version(), time.strftime("%Y-%m-%d %H:%M"), distance_m, [one.facts for one in benches])
    async with contextlib.AsyncExitStack() as stack:
        for bench in benches:
            await stack.enter_async_context(bench.running())
        ready = [bench for bench in benches if await _alone(bench, amounts, reach)]
        try:
            await _together(ready, amounts, reach)
        except TroubleError as error:
            for bench in ready:
                bench.facts.trouble = str(error)
    return report


async def _alone(bench: Bench, amounts: Amounts, reach: Callable[[str], None]) -> bool:
    """Line, processor and chip; whether the chip can be used."""
    try:
        reach(f"{bench.facts.name}: connecting")
        await bench.connect()
        for baud in sorted(BAUDS):
            reach(f"{bench.facts.name}: line at {baud:,} baud")
            await bench.test_line(baud, amounts.records)
        await bench.use_cleanest_rate()
        reach(f"{bench.facts.name}: processor and chip")
        return await bench.test_chip(amounts)
    except TroubleError as error:
        bench.facts.trouble = str(error)
        return False


async def _together(benches: Sequence[Bench], amounts: Amounts, reach: Callable[[str], None]) -> None:
    """Send in turns; the receivers' first minute is part of it. A board alone sends only some frames."""
    if not benches:
        return
    is_pair = len(benches) > 1
    seconds = amounts.pair_s if is_pair else max(amounts.clocks_s, 4 * _FRAME_S * amounts.alone_frames)
    reach(f"{' and '.join(one.facts.name for one in benches)}: frames for {seconds:.0f} s")
    for bench in benches:
        await bench.note_clocks()
        await bench.receive()
    period_s = _FRAME_S if is_pair else seconds / amounts.alone_frames
    frames, began_s = round(seconds / period_s), time.monotonic()
    for number in range(frames):
        await asyncio.sleep(max(began_s + number * period_s - time.monotonic(), 0.0))
        benches[number % len(benches)].send_frame(number)
    await asyncio.sleep(_ANSWER_S)
    for bench in benches:
        await bench.finish()
