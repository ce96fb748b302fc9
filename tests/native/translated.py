"""Functions that ``test_translator.py`` translates: each construct of the subset, and the comments around it."""

from typing import Annotated, Final

from skyless.core.native.arithmetic import exp, floor, hypot, log, sqrt
from skyless.core.native.records import Array, Byte, Bytes, Integers, Matrix, Reals, Record, Ticks, record

ROWS, COLUMNS = 3, 4
_SHARE: Final = 0.3  # of what
NEVER: Final = -(1 << 62)
"""A time before all others."""
EXACT: Final = True


@record
class Point(Record):
    """A place."""

    x: float
    y: float
    kind: Byte


@record
class Box(Record):
    """Everything that a record may hold."""

    count: int  # how many
    # Time
    ticks: Ticks
    """Of the newest."""
    is_open: bool
    default: float
    origin: Point
    points: Annotated[Array[Point], ROWS]
    P: Annotated[Matrix, ROWS, COLUMNS]
    reals: Annotated[Reals, COLUMNS]
    counts: Annotated[Integers, ROWS]
    bytes: Annotated[Bytes, 5]
    stamps: Annotated[Array[Ticks], ROWS]


# Numbers


def arithmetic(a: float, b: float, c: float) -> float:
    """Terms and factors, with parentheses where Python has them."""
    return a - (b - c) * 2 + -a * (b + 1.5) / (1.0 + c * c) - (a * b) * (a - c)


def of_whole_numbers(a: int, b: int, c: Ticks) -> Ticks:
    """What rounds down in Python, and bits."""
    divisor = b if b != 0 else 7
    quotient, remainder = a // divisor, c % divisor
    quotient += (a & 0xFF) ^ (b | 3)
    low: int = c >> 3
    low &= 1023
    big = c
    big //= divisor
    big <<= 2
    return quotient * 3 + remainder - (c << 5) + ~a + (a << 3) + low + big + (NEVER >> 50) + 0x123456789A


def mixed(a: int, b: Ticks, x: float, on: bool) -> float:
    """Whole numbers in real arithmetic."""
    y: float = a
    y += a
    y *= 1.0 + a / 3 + a / (abs(a) + 1)
    z = x
    z = a if on else z
    return b * 0.5 + y + z + on + ROWS * _SHARE + float(b) + (x if EXACT else a)


def rounding(x: float, y: float) -> Ticks:
    return floor(x) + int(y) + floor(-0.5) + int(True)


def choosing(a: int, b: int, x: float, y: float, c: Ticks) -> float:
    """Least, largest and absolute values, with Python's order of equal ones."""
    least = min(a, b, 3)
    return max(x, y, -0.0) + least + min(x, 0) + abs(a) + abs(x) + max(a, c) * 1.0


def decisions(a: int, b: int, x: float, on: bool) -> int:
    """Which branch."""
    result = 0
    if a < b and not (on or x > 0.0):  # both
        result = 1
    elif 0 <= a < b != 7 or a == b:
        result = 2 if x != 0.0 else 3
    else:
        if on:
            result = -4
        # Otherwise nothing.
    if a == 0:
        result += 10
    is_same = bool(a) == on
    is_same &= (x <= 1.0 or on) != (b > 2 and not on)
    return result * 2 + is_same


def loops(count: int, step_count: int) -> int:
    """Ranges, whose bounds are evaluated once."""
    total, limit = 0, count
    for i in range(limit):
        limit -= 1
        if i % 5 == 4:
            continue
        for j in range(i, -3, -2):
            total += i * j
            if total > 100000:
                break
        for _ in range(step_count):
            for _ in range(2):
                total += 1
    for i in range(3, count + 1, 3):
        total -= i
    while total > 50:
        total = total // 2
        if total == 60:
            return 60
    return total


def first_in_branches(on: bool, count: int) -> float:
    """Locals whose first assignment is within a block keep their value for what follows."""
    last = -1.0
    for i in range(count):
        if i % 3 == 0:
            kept = 0.5 * i
        else:
            last += kept
    if on:
        scale = 2.0
        last += 1.0
    else:
        scale = 3.0
    return last * scale


def made_within_a_block(on: bool, x: float) -> float:
    """A record that is made within a block lives as long as the call."""
    found = Point()
    found.x = x
    place = found
    if on:
        other = Point()
        other.x = 2.0 * x
        place = other
    return place.x


def together(a: float, b: float, c: int) -> float:
    """Assignments at the same time."""
    a, b = b, a
    a, b, d = a + b, a - b, c
    e = f = a * 0.5
    e += 1.0
    return a * 3.0 + b + d + e * f


def _pair(x: float, count: int = 2, scale: float = 0.5) -> tuple[float, int, bool]:
    return x * scale, count + 1, x > 1.0


def tuples(x: float) -> float:
    a, count, is_large = _pair(x)
    b, _, _ = _pair(x, scale=0.25)
    c, d, is_large = _pair(scale=x, x=2.0, count=5)
    return a + count + b + c * d if is_large else a - b


def keywords(short: float, long: int) -> float:
    """Names that mean something in C."""
    switch, index, register = short, long, 2.0
    return switch * register + index


def functions(x: float, y: float) -> float:
    return exp(-abs(x)) + log(1.0 + abs(y)) + hypot(x, y) + sqrt(abs(x * y))


# Records


def _sum(values: Reals, count: int) -> float:
    total = 0.0
    for i in range(count):
        total += values[i]
    return total


def _scale(P: Annotated[Matrix, ROWS, COLUMNS], factor: float) -> None:
    for i in range(ROWS):
        row = P[i]
        for j in range(COLUMNS):
            row[j] *= factor
            P[i][j] += 1


def _take(p: Point) -> float:
    """A number, and the place is another afterwards."""
    p.x = p.x + 1.0
    return p.x


def _nearer(one: Point, other: Point) -> Point:
    return one if one.x <= other.x else other


def choose(box: Box, kind: int) -> bool:
    """Records as results, and membership."""
    nearest = _nearer(_nearer(box.origin, box.points[0]), box.points[1])
    nearest.y += 1.0
    _nearer(box.origin, nearest).x *= 2.0
    is_known = kind in (1, ROWS, box.count) and box.count not in (2, 5)
    return is_known and (nearest.y > _nearer(nearest, box.origin).y or box.count in (3,))


def work(box: Box, factor: float) -> float:
    """Fields, elements and references."""
    origin, P, reals = box.origin, box.P, box.reals
    origin.x, origin.y = origin.y, origin.x
    near = box.points[1]
    near.x += factor
    near.kind += 200
    near = box.points[box.count & 1]
    near.y = box.default if box.is_open else -1
    box.points[2] = near
    _scale(P, factor)
    _scale(box.P, 0.5)
    made = Point()
    made.x = factor
    got = _take(made)
    got += _take(origin)
    box.points[0] = made
    either = near if box.is_open else box.origin
    either.kind = box.counts[0]
    box.counts[1] = box.ticks
    box.counts[2] += box.bytes[0] << 4
    box.stamps[0] = box.stamps[1] = box.ticks % 1000
    box.ticks -= NEVER >> 2
    box.is_open = not box.is_open
    reals[0], reals[1] = reals[1], reals[0]
    box.bytes[1] = box.bytes[2] = box.bytes[3] + 250
    while box.points[2].x > 1.0:
        box.points[2].x *= 0.5
    return got + _sum(reals, COLUMNS) + _sum(P[1], 2) + made.x


def stamp(bytes_: Bytes) -> Ticks:
    """Five bytes, the lowest first."""
    ticks: Ticks = 0
    for i in range(4, -1, -1):
        ticks = ticks << 8 | bytes_[i]
    return ticks


def ignore(box: Box, nothing: int) -> None:
    """What comes of a call, and arguments, may be ignored."""
    _take(box.origin)
    if box.count > 0:
        return
    if nothing > 0:
        pass
    box.count = 1
