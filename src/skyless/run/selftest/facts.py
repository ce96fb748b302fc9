"""What a self-test has found of boards, as its report keeps it, and what that means.

Every judgement is made here, from the report alone: a report that somebody sends can be judged again.
"""

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from skyless.core.ticks import DEFAULT_ANTENNA_DELAY_TICKS, TICK_M, TICK_RATE_HZ, TICK_S, WRAP_TICKS
from skyless.radio.serial import link
from skyless.run.doctor import Check

CHIP_HZ: Final = (2_000_000, 8_000_000)
"""The slow and the fast SPI clock of a board."""
PATTERN: Final = bytes.fromhex("a55a00ff")
FRAME_BYTES: Final = 100
OTP_WORDS: Final = {
    "part": 0x06, "lot": 0x07, "ldo_tune": 0x04, "voltage": 0x08, "temperature": 0x09, "tx_power": 0x19,
    "antenna_delay": 0x1C, "crystal_trim": 0x1E,
}  # fmt: skip
"""Words of the one-time programmable memory that are read (DW1000 User Manual v2.12, table 10)."""


class LineTest(Struct, frozen=True):
    """Records of one length at one rate, one way."""

    baud: int
    from_board: bool
    line_bytes: int
    sent: int
    came: int


class Reading(Struct, frozen=True):
    """A register of the chip that was read many times; the first reading in hexadecimal digits."""

    hz: int
    expected: str
    found: str
    times: int
    differing: int


class Clocks(Struct, frozen=True):
    """A board's clocks at one moment."""

    us: int
    slow_periods: int
    ticks: int


class Heard(Struct, frozen=True, array_like=True):
    """A frame of the other board."""

    number: int
    rx_ticks: int
    power_dbm: float | None
    carrier_ppm: float | None


class BoardFacts(Struct):
    """What was found of one board."""

    name: str
    path: str
    firmware: tuple[int, ...] = ()
    device_id: str = ""
    reset_cause: int = 0
    can_transmit: bool = True
    baud: int = 0
    """Rate of its port, as its flash has it."""
    trouble: str = ""
    """Why its test ended early."""
    lines: list[LineTest] = []
    processor: tuple[int, int, int, int, int, int, int] | None = None
    """In the order of the firmware's ``enum probe``."""
    start_step: int | None = None
    """Where the chip's start ended, if it did not start."""
    readings: list[Reading] = []
    otp: dict[str, int] = {}
    clocks: list[Clocks] = []
    counts: tuple[int, int, int, int, int] | None = None
    """Time until the chip's PLL locked in µs, slips of its clock and of its carrier, the time of the last reception in
    µs, and records that tested the line."""
    temperature_c: float | None = None
    supply_v: float | None = None
    asked: int = 0
    """Delayed frames that it was to send."""
    late: int = 0
    """Those that came too late to be sent."""
    tx_ticks: dict[int, int] = field(default_factory=dict)
    """TX stamps of the others, by their numbers."""
    wrong: list[tuple[int, int]] = []
    """Those that left at another time: number, and by how many ticks too late."""
    heard: list[Heard] = []


class Report(Struct):
    """The report file; when it was made in local time, the distance of the antennas as a person measured it."""

    skyless_version: str
    made: str
    distance_m: float | None
    boards: list[BoardFacts]


def judge(report: Report) -> list[Check]:
    """Every check of a report; each that failed has a sentence of its own."""
    checks = [check for board in report.boards for check in _board(board)]
    if len(report.boards) == 2:
        a, b = report.boards
        is_pair = a.tx_ticks and b.tx_ticks
        checks += _pair(a, b, report.distance_m) if is_pair else [Check("pair", "not checked", "A board did not send.")]
    return checks


_REPORT: Final = "Please report this."
_SUPPLY: Final = "Measure the supply at the module; another USB port or cable."
_PLACE: Final = "Put them 1 to 2 m apart, nothing between or beside."
_NRF52832: Final = 0x52832
_REVISIONS: Final = {5: 1, 6: 2, 7: 3}
"""By what an nRF52832 states."""
_RESET_PIN: Final = 21
_OPEN_PORT: Final = {1: 0xFF, 2: 0xFF, 3: 0x5A}
"""In UICR: the pin of the reset button, and by the revision the value that leaves the debug port open."""
_BAD_CAUSES: Final = link.RESET_BY_WATCHDOG | link.RESET_BY_LOCKUP | link.RESET_BY_FAULT
_NO_LOCK: Final = 2
"""Of ``start_step``."""
_SLOW_HZ: Final = 32_768
_RECEPTION_US: Final = 275.0
"""By docs/hardware.md, good to a quarter."""


def _check(name: str, *, fails: bool, sentence: str, finding: str, advice: str = _REPORT) -> Check:
    return Check(name, "failed", sentence, advice) if fails else Check(name, "ok", finding)


def _board(board: BoardFacts) -> Iterator[Check]:
    name, version = f"board {board.name}", ".".join(map(str, board.firmware))
    found = f"{board.path}, firmware {version}, device {board.device_id}."
    line = [_line(f"{name}, line", board)] if board.lines else []
    if board.trouble and line and line[0].result == "failed":  # which explains it
        yield Check(name, "not checked", board.trouble, "Fix the line first.")
    else:
        yield _check(name, fails=bool(board.trouble), sentence=board.trouble, finding=found, advice="")
    yield from line
    if board.processor is not None:
        yield _processor(f"{name}, processor", board.processor, board.reset_cause)
    if board.readings:
        yield _chip(f"{name}, DW1000", board)
    if board.otp:
        part, trim = board.otp.get("part", 0), board.otp.get("crystal_trim", 0) & 0x1F
        sentence = "The crystal was never trimmed: offsets up to 20 ppm."
        if not part:
            sentence = "The chip's memory holds no part number: it was never tested."
        found = f"Part {part:08X}, crystal trim {trim}."
        yield _check(f"{name}, factory data", fails=not (part and trim), sentence=sentence, finding=found)
    if len(board.clocks) > 1:
        yield from _clocks(name, board.clocks[0], board.clocks[-1])
    if board.counts is not None:
        yield from _counts(name, board, *board.counts[:4])
    if not board.can_transmit:
        yield Check(f"{name}, delayed frames", "not checked", "It only listens: pin 13 is tied to ground.")
    elif board.asked:
        yield _sending(f"{name}, delayed frames", board)


def _line(name: str, board: BoardFacts) -> Check:
    """Whether the board's own rate is clean, and which rates are."""
    spoilt = {one.baud: 0.0 for one in board.lines}
    if board.baud not in spoilt:
        return Check(name, "not checked", f"Its own rate of {board.baud:,} baud was not tested.")
    for one in board.lines:
        spoilt[one.baud] = max(spoilt[one.baud], 1.0 - one.came / max(one.sent, 1))
    clean = sorted(baud for baud, share in spoilt.items() if share == 0.0)
    found = f"Clean at {', '.join(f'{baud:,}' for baud in clean)} baud; it works at {board.baud:,}."
    if clean:
        sentence = f"This port carries {clean[-1]:,} baud, not {board.baud:,}."
        advice = f"skyless flash-config --radio serial:{board.path} --baud {clean[-1]}"
    else:
        share = 100 * spoilt[board.baud]
        sentence = f"This port spoils records at every rate, {share:.1f} % at {board.baud:,} baud."
        advice = "Try another cable, another port of the computer, no hub."
    return _check(name, fails=board.baud not in clean, sentence=sentence, finding=found, advice=advice)


def _processor(name: str, facts: tuple[int, int, int, int, int, int, int], cause: int) -> Check:
    part, _, word, reset_pin, debug, stack, used = facts
    revision, share = word >> 4 & 0xF, used / max(stack, 1)
    sentence, advice = "", _REPORT
    if part != _NRF52832:
        sentence = f"This processor is a {part:X}, not an nRF52832."
    elif revision not in _REVISIONS:
        sentence = f"Unknown revision {revision}: please report."
    elif cause & _BAD_CAUSES:
        sentence = f"Its firmware failed, and started again (cause {cause:#04x})."
    elif share >= 0.8:
        sentence = f"The stack was used to {100 * share:.0f} %."
    elif (reset_pin, debug & 0xFF) != (_RESET_PIN, _OPEN_PORT[_REVISIONS[revision]]):
        sentence, advice = "UICR was not flashed: reset button or debug port do not work.", "skyless flash"
    found = f"nRF52832, revision {_REVISIONS.get(revision)}, stack used to {100 * share:.0f} %."
    return _check(name, fails=bool(sentence), sentence=sentence, finding=found, advice=advice)


def _chip(name: str, board: BoardFacts) -> Check:
    """Identifier and a pattern, at both clocks of the SPI, and the start."""
    worst = max(board.readings, key=lambda one: (one.differing, one.found != one.expected))
    sentence, advice = "", _REPORT
    if worst.differing:
        number, rate = f"{worst.differing:,} of {worst.times:,}", f"{worst.hz / 1e6:g} MHz"
        sentence = f"{number} readings of {worst.expected} at {rate} differ: the SPI is disturbed."
    elif worst.found != worst.expected:
        why = {"FFFFFFFF": "the chip has no supply or is not selected", "00000000": "no chip drives the line"}
        meaning = why.get(worst.found, "this is no DW1000")
        sentence = f"Read {worst.found} {worst.times:,} times: {meaning}."
    elif board.start_step == _NO_LOCK:
        sentence, advice = "The DW1000 answers, but its clock does not lock: supply.", _SUPPLY
    elif board.start_step:
        sentence = "The DW1000 answers at 2 MHz, but not at 8: the SPI is disturbed."
    found = f"Identifier and a pattern were read {worst.times:,} times each at 2 and 8 MHz, all right."
    return _check(name, fails=bool(sentence), sentence=sentence, finding=found, advice=advice)


def _clocks(name: str, first: Clocks, last: Clocks) -> Iterator[Check]:
    """Both crystals of the processor, and the chip's counter, over the time between two readings."""
    passed_s = 1e-6 * max(last.us - first.us & 0xFFFF_FFFF, 1)
    slow_ppm = 1e6 * ((last.slow_periods - first.slow_periods & 0xFF_FFFF) / _SLOW_HZ / passed_s - 1.0)
    sentence = "The slow crystal does not run; sleeping tags will be off."
    if abs(slow_ppm) < 1000.0:  # an RC oscillator is worse
        sentence = f"The slow crystal is off by {slow_ppm:+.0f} ppm: please report."
    found = f"Against the fast one {slow_ppm:+.0f} ppm over {passed_s:.0f} s."
    yield _check(f"{name}, slow crystal", fails=abs(slow_ppm) > 200.0, sentence=sentence, finding=found)
    chip_ppm = 1e6 * _wrapped(last.ticks - first.ticks - passed_s * TICK_RATE_HZ) / (passed_s * TICK_RATE_HZ)
    sentence = f"The DW1000's crystal and the processor's differ by {chip_ppm:+.0f} ppm."
    found = f"Against the processor's {chip_ppm:+.1f} ppm."
    yield _check(f"{name}, chip's counter", fails=abs(chip_ppm) > 60.0, sentence=sentence, finding=found)


def _counts(name: str, board: BoardFacts, lock_us: int, clock: int, carrier: int, reception_us: int) -> Iterator[Check]:
    sentence = f"The clock slips ({clock} times, the carrier's {carrier}): supply."
    found = f"It locked within {lock_us / 1000:.1f} ms and did not slip."
    fails = bool(clock or carrier)
    yield _check(f"{name}, PLL", fails=fails, sentence=sentence, finding=found, advice=_SUPPLY)
    if board.temperature_c is not None and board.supply_v is not None:
        is_off = not 3.0 <= board.supply_v <= 3.5
        sentence = f"The chip is at {board.temperature_c:.0f} °C."
        sentence = f"The supply is {board.supply_v:.2f} V, not 3.3." if is_off else sentence
        found = f"{board.temperature_c:.0f} °C, {board.supply_v:.2f} V."
        fails = is_off or not 5.0 <= board.temperature_c <= 60.0
        yield _check(f"{name}, temperature, supply", fails=fails, sentence=sentence, finding=found, advice=_SUPPLY)
    if board.heard:
        error = abs(reception_us / _RECEPTION_US - 1.0)
        sentence = f"The table of cycles is wrong by {100 * error:.0f} %: please report."
        found = f"{reception_us} µs for {FRAME_BYTES} bytes."
        yield _check(f"{name}, time of a reception", fails=error > 0.25, sentence=sentence, finding=found)


def _sending(name: str, board: BoardFacts) -> Check:
    if len(board.tx_ticks) + board.late < board.asked // 2:
        return Check(name, "not checked", f"Of {board.asked} frames the board confirmed {len(board.tx_ticks)}.")
    if board.late > board.asked // 10:
        advice = "Close other programs and repeat; a slow computer needs longer slots."
        return Check(name, "warning", f"{board.late} of {board.asked} frames came too late to be sent.", advice)
    number, ticks = next(iter(board.wrong), (0, 0))
    many = f" ({len(board.wrong)} frames left at another time)" if len(board.wrong) > 1 else ""
    sentence = f"Frame {number} left {abs(ticks)} ticks {'late' if ticks > 0 else 'early'}{many}."
    found = f"{len(board.tx_ticks)} of {board.asked} frames left at their time."
    return _check(name, fails=bool(board.wrong), sentence=sentence, finding=found)


# Two boards

_MIN_FRAMES: Final = 20
_ENDS_S: Final = 5.0
"""Of the first and the last seconds the rates of the counters are compared."""


class Direction(Struct, frozen=True):
    """What the frames from one board to the other show.

    The carrier is the sender's against the receiver's, as the receiver measured it, and the counter the same by stamps.
    The jitter is a stamp's against its neighbours, both ends together; the drift that of the counters' rate.
    """

    lost: float
    power_dbm: float
    carrier_ppm: float
    counter_ppm: float
    jitter_ps: float
    drift_ppm: float
    passed_s: float


def direction(sender: BoardFacts, receiver: BoardFacts) -> Direction | None:
    """Evaluate the frames of one direction; None if too few were heard."""
    rows = [one for one in receiver.heard if one.number in sender.tx_ticks]
    if len(rows) < _MIN_FRAMES:
        return None
    sent_s, late_s = _times(sender, rows)
    left = (sent_s[2:] - sent_s[1:-1]) / np.maximum(sent_s[2:] - sent_s[:-2], TICK_S)
    beside = late_s[1:-1] - left * late_s[:-2] - (1.0 - left) * late_s[2:]
    parts = sent_s >= 0.0, sent_s <= _ENDS_S, sent_s >= sent_s[-1] - _ENDS_S
    rate, begin, end = (
        np.polyfit(sent_s[part], late_s[part], 1)[0] if part.sum() >= _MIN_FRAMES else math.nan for part in parts
    )
    return Direction(
        lost=1.0 - len(rows) / len(sender.tx_ticks),
        power_dbm=_mean([one.power_dbm for one in rows]),
        carrier_ppm=_mean([one.carrier_ppm for one in rows]),
        counter_ppm=-1e6 * float(rate),
        jitter_ps=1e12 * math.sqrt(np.mean(beside**2 / (1.0 + left**2 + (1.0 - left) ** 2))),
        drift_ppm=1e6 * float(begin - end),
        passed_s=float(sent_s[-1]),
    )


def _mean(values: list[float | None]) -> float:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else math.nan


def _wrapped(ticks: float) -> float:
    """A difference of counters as the one that is nearest to 0."""
    return (ticks + WRAP_TICKS / 2) % WRAP_TICKS - WRAP_TICKS / 2


def _times(sender: BoardFacts, rows: list[Heard]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """When frames left after the first, by the sender's counter; and how much longer they took than the first."""
    passed = np.array([(sender.tx_ticks[one.number] - sender.tx_ticks[rows[0].number]) % WRAP_TICKS for one in rows])
    sent = passed + WRAP_TICKS * np.cumsum(np.diff(passed, prepend=0) < 0)
    late = [_wrapped(one.rx_ticks - rows[0].rx_ticks - int(ticks)) for one, ticks in zip(rows, sent, strict=True)]
    return sent * TICK_S, np.array(late) * TICK_S


def two_way_ticks(first: BoardFacts, second: BoardFacts) -> float:
    """The time of flight between two antennas in ticks, with antenna delays as configured.

    A frame of the second board reaches the first; one that left there at that moment, interpolated between real ones,
    would come back: half of the time between, by the second's counter, without any offset of the clocks.
    """
    rows = [one for one in second.heard if one.number in first.tx_ticks]
    sent_s, late_s = _times(first, rows)
    began_tx, began_rx, turn, found = first.tx_ticks[rows[0].number], rows[0].rx_ticks, WRAP_TICKS * TICK_S, []
    for one in first.heard:
        passed = one.rx_ticks - began_tx
        about_s = float(np.interp(one.number, [row.number for row in (rows[0], rows[-1])], [0.0, sent_s[-1]]))
        at_s = passed * TICK_S + turn * round((about_s - passed * TICK_S) / turn)
        if one.number in second.tx_ticks and sent_s[0] < at_s < sent_s[-1]:
            returned = began_rx + passed + float(np.interp(at_s, sent_s, late_s)) / TICK_S
            found.append(_wrapped(returned - second.tx_ticks[one.number]) / 2)
    return float(np.median(found))


def _pair(a: BoardFacts, b: BoardFacts, distance_m: float | None) -> Iterator[Check]:
    there, back = direction(a, b), direction(b, a)
    for sender, receiver, one in ((a.name, b.name, there), (b.name, a.name, back)):
        lost = 1.0 if one is None else one.lost
        sentence = f"{receiver} loses {100 * lost:.0f} % of {sender}'s frames."
        sentence = f"{receiver} does not hear {sender}." if one is None else sentence
        found = "" if one is None else f"{100 * lost:.1f} % lost, {one.power_dbm:.0f} dBm."
        yield _check(f"{sender} to {receiver}", fails=lost > 0.05, sentence=sentence, finding=found, advice=_PLACE)
    if there is None or back is None:
        return
    less_db = back.power_dbm - there.power_dbm
    sender, receiver = (a.name, b.name) if less_db > 0.0 else (b.name, a.name)
    weaker = f"{receiver} hears {sender} {abs(less_db):.0f} dB weaker"
    sentence = f"{weaker} than {sender} hears {receiver}: antenna covered?"
    found = f"Both ways equal within {abs(less_db):.1f} dB."
    yield _check("pair, power", fails=abs(less_db) > 4.0, sentence=sentence, finding=found, advice=_PLACE)
    differ, stated = abs(there.counter_ppm), f"{there.carrier_ppm:+.1f} and {back.carrier_ppm:+.1f} ppm"
    is_unequal = abs(there.carrier_ppm + back.carrier_ppm) > 0.5
    sentence = f"The boards state offsets of {stated}, not opposite ones."
    sentence = sentence if is_unequal else f"The crystals differ by {differ:.0f} ppm."
    found = f"The crystals differ by {differ:.1f} ppm."
    yield _check("pair, crystals", fails=is_unequal or differ > 20.0, sentence=sentence, finding=found)
    jitter_ps, drifted = max(there.jitter_ps, back.jitter_ps), f"{there.drift_ppm:+.2f} ppm in {there.passed_s:.0f} s"
    sentence = f"Stamps jitter by {jitter_ps:.0f} ps: first path not found, metal near?"
    found = f"They jitter by {jitter_ps:.0f} ps; the counters' rates drifted by {drifted}."
    yield _check("pair, stamps", fails=jitter_ps > 200.0, sentence=sentence, finding=found, advice=_PLACE)
    if distance_m is not None:
        measured_m = TICK_M * two_way_ticks(a, b)
        delay_ticks = DEFAULT_ANTENNA_DELAY_TICKS + (measured_m - distance_m) / TICK_M / 2.0
        sentence = f"Delays off by {abs(measured_m - distance_m):.1f} m: calibrate."
        found = f"{distance_m:g} m were measured as {measured_m:.2f}: mean antenna delay {delay_ticks:.0f} ticks."
        fails = abs(delay_ticks - DEFAULT_ANTENNA_DELAY_TICKS) > 400.0
        yield _check("pair, distance", fails=fails, sentence=sentence, finding=found, advice="skyless calibrate")
