"""What a self-test has found of boards, as its report keeps it, and what that means.

Every judgement is made here, from the report alone: a report that somebody sends can be judged again.
"""

import math
from collections.abc import Iterator, Sequence
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
    "part": 0x06, "lot": 0x07, "ldo_tune": 0x04, "voltage": 0x08, "temperature": 0x09, "tx_power": 0x12,
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
    """A register that was read many times, or written and read."""

    hz: int
    expected: str
    found: str
    """The first reading, in hexadecimal digits."""
    times: int
    differing: int


class Clocks(Struct, frozen=True):
    """A board's clocks at one moment."""

    us: int
    slow_periods: int
    ticks: int


class Sending(Struct):
    """Delayed frames that a board was asked to send."""

    asked: int = 0
    late: int = 0
    """Frames that came too late to be sent."""
    wrong: list[tuple[int, int]] = []
    """Frames that left at another time: which, and by how many ticks too late."""
    tx_ticks: dict[int, int] = {}
    """Their TX stamps."""


class Heard(Struct, frozen=True, array_like=True):
    """A frame of the other board."""

    number: int
    rx_ticks: int
    power_dbm: float | None
    offset_ppm: float | None


class BoardFacts(Struct):
    """What was found of one board."""

    name: str
    path: str
    firmware: tuple[int, ...] = ()
    device_id: str = ""
    reset_cause: int | None = None
    baud: int = 0
    """Rate of its port, as its flash has it."""
    trouble: str = ""
    """Why the test of this board ended early."""
    lines: list[LineTest] = []
    processor: list[int] = []
    """As ``enum probe`` of the firmware counts its facts."""
    start_step: int | None = None
    """Where the chip's start ended, if it did not start."""
    identifiers: list[Reading] = []
    patterns: list[Reading] = []
    otp: dict[str, int] = {}
    clocks: list[Clocks] = []
    counts: list[int] = []
    """Time until the chip's PLL locked in µs, slips of its clock and of its carrier, the time of the last reception in
    µs, and records that tested the line."""
    temperature_c: float | None = None
    supply_v: float | None = None
    sending: Sending = field(default_factory=Sending)
    heard: list[Heard] = []


class Report(Struct):
    """The report file."""

    skyless_version: str
    made: str
    """When, in local time."""
    distance_m: float | None
    """Between the antennas, as measured by a person."""
    boards: list[BoardFacts] = []


def judge(report: Report) -> list[Check]:
    """Every check of a report; each that failed has a sentence of its own."""
    return [check for board in report.boards for check in _board(board)] + list(_pair(report))


def _check(name: str, trouble: str, finding: str, advice: str = "Please report this.") -> Check:
    """A check that has failed if there is trouble; else its finding."""
    return Check(name, "failed", trouble, advice) if trouble else Check(name, "ok", finding)


# One board

_NO_LOCK: Final = 2
"""Of ``start_step``."""
_NRF52832: Final = 0x52832
_REVISIONS: Final = {5: 1, 6: 2, 7: 3}
"""By what an nRF52832 states; UICR's lock of the debug port is new in revision 3."""
_RESET_PIN, _OPEN_DEBUG_PORT = 21, 0x5A
_MAX_STACK: Final = 0.8
_MAX_SLOW_PPM: Final = 200.0
_MAX_CLOCKS_PPM: Final = 60.0
_SLOW_HZ: Final = 32_768
_SLOW_MASK: Final = 0xFFFFFF
_MAX_LOCK_US: Final = 5000
_TEMPERATURES_C: Final = (5.0, 60.0)
_SUPPLIES_V: Final = (3.0, 3.5)
_RECEPTION_US: Final = 275.0
_RECEPTION_TOLERANCE: Final = 0.25
_BAD_CAUSES: Final = {
    link.RESET_BY_WATCHDOG: "its watchdog",
    link.RESET_BY_LOCKUP: "a lockup of its processor",
    link.RESET_BY_FAULT: "a fault that its firmware noticed",
}


def _board(board: BoardFacts) -> Iterator[Check]:
    name = f"board {board.name}"
    version = ".".join(map(str, board.firmware))
    yield _check(name, board.trouble, f"{board.path}, firmware {version}, device {board.device_id}.", "")
    if board.lines:
        yield _line(f"{name}, line", board)
    if board.processor:
        yield _processor(f"{name}, processor", board)
    if board.identifiers:
        yield _chip_answers(f"{name}, DW1000", board)
    if board.otp:
        trim = board.otp["crystal_trim"] & 0x1F
        trouble = "" if trim else "The crystal was never trimmed: offsets up to 20 ppm."
        if not board.otp["part"]:
            trouble = "The chip's memory holds no part number: it was never tested."
        yield _check(f"{name}, factory data", trouble, f"Part {board.otp['part']:08X}, crystal trim {trim}.", "")
    if len(board.clocks) > 1:
        yield from _clocks(name, board.clocks[0], board.clocks[-1])
    if board.counts:
        yield from _chip(name, board)
    if board.sending.asked:
        yield _sending(f"{name}, delayed frames", board.sending)


def _line(name: str, board: BoardFacts) -> Check:
    """Whether the board's own rate is clean, and which rates are."""
    spoilt = {
        baud: max(1.0 - one.came / one.sent for one in board.lines if one.baud == baud)
        for baud in sorted({one.baud for one in board.lines})
    }
    clean = [baud for baud, share in spoilt.items() if share == 0.0]
    finding = f"Clean at {', '.join(f'{baud:,}' for baud in clean)} baud; it works at {board.baud:,}."
    if spoilt.get(board.baud, 0.0) == 0.0:
        return _check(name, "", finding)
    if not clean:
        worst = 100.0 * spoilt[board.baud]
        trouble = f"This port spoils records at every rate, {worst:.1f} % at {board.baud:,} baud."
        return _check(name, trouble, "", "Try another cable, another port of the computer, no hub.")
    best = clean[-1]
    trouble = f"This port carries {best:,} baud, not {board.baud:,}."
    return _check(name, trouble, "", f"skyless flash-config --radio serial:{board.path} --baud {best}")


def _processor(name: str, board: BoardFacts) -> Check:
    part, _, word, reset_pin, debug, stack, used = board.processor[:7]
    revision, share = word >> 4 & 0xF, used / max(stack, 1)
    trouble, advice = "", "Please report this."
    causes = [text for bit, text in _BAD_CAUSES.items() if (board.reset_cause or 0) & bit]
    if part != _NRF52832:
        trouble = f"This processor is a {part:X}, not an nRF52832."
    elif revision not in _REVISIONS:
        trouble = f"Unknown revision {revision}: please report."
    elif causes:
        trouble = f"It was last restarted by {' and '.join(causes)}."
    elif share >= _MAX_STACK:
        trouble = f"The stack was used to {100 * share:.0f} %."
    elif reset_pin != _RESET_PIN or (_REVISIONS[revision] >= 3 and debug & 0xFF != _OPEN_DEBUG_PORT):
        trouble = "The flashing has left out UICR: the reset button, or the debug port, does not work."
        advice = "Flash the board with skyless flash."
    finding = f"nRF52832, revision {_REVISIONS.get(revision)}, stack used to {100 * share:.0f} %."
    return _check(name, trouble, finding, advice)


def _chip_answers(name: str, board: BoardFacts) -> Check:
    """Identifier and a pattern, at both clocks of the SPI."""
    worst = max(board.identifiers + board.patterns, key=lambda one: one.differing)
    wrong = next((one for one in board.identifiers if one.found != one.expected), None)
    if wrong is not None and not worst.differing:
        meaning = {"FFFFFFFF": "the chip has no supply or is not selected", "00000000": "no chip drives the line"}
        why = meaning.get(wrong.found, "this is no DW1000, or the SPI is disturbed")
        return _check(name, f"Read {wrong.found} {wrong.times:,} times: {why}.", "")
    if board.start_step == _NO_LOCK:
        trouble = "The DW1000 answers, but its clock does not lock: supply."
        return _check(name, trouble, "", "Measure the supply at the module; another USB port or cable.")
    trouble = f"{worst.differing:,} of {worst.times:,} readings of {worst.expected} at {worst.hz / 1e6:g} MHz differ."
    if board.start_step:
        return _check(name, "The DW1000 answers at 2 MHz, but not at 8: the SPI is disturbed.", "")
    finding = f"Identifier and a pattern were read {worst.times:,} times each at 2 and 8 MHz, all right."
    return _check(name, trouble if worst.differing else "", finding)


def _clocks(name: str, first: Clocks, last: Clocks) -> Iterator[Check]:
    """Both crystals of the processor, and the chip's counter, over the time between two readings."""
    passed_s = 1e-6 * (last.us - first.us & 0xFFFF_FFFF)
    periods = last.slow_periods - first.slow_periods & _SLOW_MASK
    slow_ppm = 1e6 * (periods / _SLOW_HZ / passed_s - 1.0)
    trouble = "The slow crystal does not run; sleeping tags will be off." if abs(slow_ppm) > _MAX_SLOW_PPM else ""
    yield _check(f"{name}, slow crystal", trouble, f"Against the fast one {slow_ppm:+.0f} ppm over {passed_s:.0f} s.")
    if last.ticks:
        expected = passed_s * TICK_RATE_HZ
        off = (last.ticks - first.ticks - expected + WRAP_TICKS / 2) % WRAP_TICKS - WRAP_TICKS / 2
        chip_ppm = 1e6 * off / expected
        trouble = f"The DW1000's crystal and the processor's differ by {chip_ppm:+.0f} ppm."
        trouble = trouble if abs(chip_ppm) > _MAX_CLOCKS_PPM else ""
        yield _check(f"{name}, chip's counter", trouble, f"Against the processor's {chip_ppm:+.1f} ppm.")


def _chip(name: str, board: BoardFacts) -> Iterator[Check]:
    lock_us, clock_slips, carrier_slips, reception_us = board.counts[:4]
    trouble = f"The clock slips ({clock_slips} times, the carrier's {carrier_slips}): supply."
    advice = "Measure the supply at the module; another USB port or cable."
    finding = f"It locked within {lock_us / 1000:.1f} ms and did not slip."
    is_bad = clock_slips or carrier_slips or lock_us > _MAX_LOCK_US
    yield _check(f"{name}, PLL", trouble if is_bad else "", finding, advice)
    if board.temperature_c is not None and board.supply_v is not None:
        found = f"{board.temperature_c:.0f} °C, {board.supply_v:.2f} V."
        trouble = ""
        if not _TEMPERATURES_C[0] <= board.temperature_c <= _TEMPERATURES_C[1]:
            trouble = f"The chip is at {board.temperature_c:.0f} °C."
        if not _SUPPLIES_V[0] <= board.supply_v <= _SUPPLIES_V[1]:
            trouble = f"The supply is {board.supply_v:.2f} V, not 3.3."
        yield _check(f"{name}, temperature and supply", trouble, found, advice)
    if board.heard and reception_us:
        error = reception_us / _RECEPTION_US - 1.0
        trouble = f"The table of cycles is wrong by {100 * abs(error):.0f} %: please report."
        trouble = trouble if abs(error) > _RECEPTION_TOLERANCE else ""
        yield _check(f"{name}, time of a reception", trouble, f"{reception_us} µs for {FRAME_BYTES} bytes.")


def _sending(name: str, sending: Sending) -> Check:
    if sending.wrong:
        number, ticks = sending.wrong[0]
        more = f" ({len(sending.wrong)} frames left at another time)" if len(sending.wrong) > 1 else ""
        return _check(name, f"Frame {number} left {abs(ticks)} ticks {'late' if ticks > 0 else 'early'}{more}.", "")
    if sending.late > sending.asked // 10:
        advice = "Close other programs and repeat; a slow computer needs longer slots."
        return Check(name, "warning", f"{sending.late} of {sending.asked} frames came too late to be sent.", advice)
    return _check(name, "", f"{len(sending.tx_ticks)} of {sending.asked} frames left at their time.")


# Two boards

_MIN_FRAMES: Final = 20
_MAX_LOST: Final = 0.05
_MAX_ASYMMETRY_DB: Final = 4.0
_MAX_OFFSET_PPM: Final = 20.0
_MAX_OFFSETS_SUM_PPM: Final = 0.5
_MAX_JITTER_PS: Final = 200.0
_MAX_DELAY_TICKS: Final = 400.0
_DRIFT_S: Final = 5.0


class Direction(Struct, frozen=True):
    """What the frames from one board to the other show."""

    lost: float
    power_dbm: float
    carrier_ppm: float
    """Of the sender's carrier against the receiver's, as the receiver measured it."""
    counter_ppm: float
    """The same of their counters."""
    jitter_ps: float
    """Standard deviation of a stamp's difference, both ends together."""
    drift_ppm: float
    """Change of the counters' rate from the first seconds to the last."""
    passed_s: float


def direction(sender: BoardFacts, receiver: BoardFacts) -> Direction | None:
    """Evaluate the frames of one direction; None if too few were heard."""
    rows = [one for one in receiver.heard if one.number in sender.sending.tx_ticks]
    if len(rows) < _MIN_FRAMES:
        return None
    sent_s, late_s = _times(sender, rows)
    line = np.polyfit(sent_s, late_s, 1)
    errors_s = late_s - np.polyval(line, sent_s)
    left = (sent_s[2:] - sent_s[1:-1]) / (sent_s[2:] - sent_s[:-2])
    beside = errors_s[1:-1] - left * errors_s[:-2] - (1.0 - left) * errors_s[2:]
    jitter_s = math.sqrt(np.mean(beside**2 / (1.0 + left**2 + (1.0 - left) ** 2)))
    begin, end = sent_s < _DRIFT_S, sent_s > sent_s[-1] - _DRIFT_S
    rates = [np.polyfit(sent_s[part], late_s[part], 1)[0] for part in (begin, end)]
    return Direction(
        lost=1.0 - len(rows) / len(sender.sending.tx_ticks),
        power_dbm=_mean([one.power_dbm for one in rows]),
        carrier_ppm=_mean([one.offset_ppm for one in rows]),
        counter_ppm=-1e6 * float(line[0]),
        jitter_ps=1e12 * jitter_s,
        drift_ppm=1e6 * float(rates[1] - rates[0]),
        passed_s=float(sent_s[-1]),
    )


def _mean(values: Sequence[float | None]) -> float:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else math.nan


def _times(sender: BoardFacts, rows: Sequence[Heard]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """When frames left after the first, by the sender's counter, and how much longer than the first they took."""
    first, began = rows[0], sender.sending.tx_ticks[rows[0].number]
    sent, turns, before = [], 0, 0
    for one in rows:
        passed = (sender.sending.tx_ticks[one.number] - began) % WRAP_TICKS
        turns += passed < before
        before = passed
        sent.append(passed + turns * WRAP_TICKS)
    late = [
        (one.rx_ticks - first.rx_ticks - ticks + WRAP_TICKS // 2) % WRAP_TICKS - WRAP_TICKS // 2
        for one, ticks in zip(rows, sent, strict=True)
    ]
    return np.array(sent) * TICK_S, np.array(late) * TICK_S


def two_way_ticks(first: BoardFacts, second: BoardFacts) -> float | None:
    """The time of flight between two antennas in ticks, antenna delays as configured; None if too few frames show it.

    A frame of the second board reaches the first; one that left there at that moment, interpolated between real ones,
    would come back: half of the time between, by the second's counter. No offset of the clocks is needed.
    """
    rows = [one for one in second.heard if one.number in first.sending.tx_ticks]
    back = [one for one in first.heard if one.number in second.sending.tx_ticks]
    if min(len(rows), len(back)) < _MIN_FRAMES:
        return None
    sent_s, late_s = _times(first, rows)
    began_tx, began_rx = first.sending.tx_ticks[rows[0].number], rows[0].rx_ticks
    found, last_s = [], 0.0
    for one in back:
        at_s = ((one.rx_ticks - began_tx) % WRAP_TICKS) * TICK_S
        at_s += WRAP_TICKS * TICK_S * round((last_s - at_s) / (WRAP_TICKS * TICK_S)) if at_s < last_s else 0.0
        last_s = at_s
        if sent_s[0] < at_s < sent_s[-1]:
            returned = began_rx + (one.rx_ticks - began_tx) + float(np.interp(at_s, sent_s, late_s)) / TICK_S
            left = second.sending.tx_ticks[one.number]
            found.append(((returned - left + WRAP_TICKS / 2) % WRAP_TICKS - WRAP_TICKS / 2) / 2)
    return float(np.median(found)) if found else None


def _pair(report: Report) -> Iterator[Check]:
    if len(report.boards) != 2 or not all(board.sending.tx_ticks for board in report.boards):
        return
    a, b = report.boards
    there, back = direction(a, b), direction(b, a)
    ways = ((a.name, b.name, there), (b.name, a.name, back))
    for sender, hearer, one in ways:
        finding = "" if one is None else f"{100 * one.lost:.1f} % lost, {one.power_dbm:.0f} dBm."
        trouble = "" if one is not None else f"{hearer} does not hear {sender}."
        if one is not None and one.lost > _MAX_LOST:
            trouble = f"{hearer} loses {100 * one.lost:.0f} % of {sender}'s frames."
        yield _check(f"{sender} to {hearer}", trouble, finding, "Put them 1 to 2 m apart, nothing between or beside.")
    if there is None or back is None:
        return
    difference_db = there.power_dbm - back.power_dbm
    sender, hearer = (a.name, b.name) if difference_db < 0.0 else (b.name, a.name)
    weaker = f"{hearer} hears {sender} {abs(difference_db):.0f} dB weaker"
    trouble = f"{weaker} than {sender} hears {hearer}: antenna covered?"
    trouble = trouble if abs(difference_db) > _MAX_ASYMMETRY_DB else ""
    yield _check("pair, power", trouble, f"Both ways equal within {abs(difference_db):.1f} dB.", "")
    yield _offsets(there, back)
    jitter_ps = max(there.jitter_ps, back.jitter_ps)
    trouble = f"Stamps jitter by {jitter_ps:.0f} ps: first path not found, metal near?"
    drifted = f"the counters' rates drifted by {there.drift_ppm:+.2f} ppm in {there.passed_s:.0f} s"
    finding = f"{there.jitter_ps:.0f} and {back.jitter_ps:.0f} ps; {drifted}."
    yield _check("pair, stamps", trouble if jitter_ps > _MAX_JITTER_PS else "", finding, "")
    flight = two_way_ticks(a, b)
    if flight is not None and report.distance_m is not None:
        error_m = flight * TICK_M - report.distance_m
        delay_ticks = DEFAULT_ANTENNA_DELAY_TICKS + error_m / TICK_M / 2.0
        trouble = f"Delays off by {abs(error_m):.1f} m: calibrate."
        trouble = trouble if abs(delay_ticks - DEFAULT_ANTENNA_DELAY_TICKS) > _MAX_DELAY_TICKS else ""
        measured = f"{report.distance_m:g} m were measured as {flight * TICK_M:.2f}"
        finding = f"{measured}: mean antenna delay {delay_ticks:.0f} ticks."
        yield _check("pair, distance", trouble, finding, "skyless calibrate")


def _offsets(there: Direction, back: Direction) -> Check:
    sum_ppm, offset_ppm = there.carrier_ppm + back.carrier_ppm, there.counter_ppm
    trouble, advice = "", "Please report this."
    if abs(sum_ppm) > _MAX_OFFSETS_SUM_PPM:
        stated = f"{there.carrier_ppm:+.1f} and {back.carrier_ppm:+.1f} ppm"
        trouble = f"The boards state offsets of {stated}, not opposite ones."
    elif abs(offset_ppm) > _MAX_OFFSET_PPM:
        trouble = f"The crystals differ by {abs(offset_ppm):.0f} ppm."
    return _check("pair, carriers", trouble, f"The crystals differ by {offset_ppm:+.1f} ppm.", advice)
