"""The serial link between a board and its host, to the byte (``docs/serial.md``): framing, check, records.

A record is ``kind | number | body | CRC-16``, stuffed (COBS) and ended by a 0 byte, which occurs nowhere else. This
file runs unchanged in MicroPython, which compiles the loops over bytes to machine code, and in CPython. Whatever is
sent and received is held in buffers that are made once; 40-bit stamps are 5 bytes and never numbers.
"""

try:
    from skyless.firmware import micropython, ptr8
except ImportError:  # a board, where MicroPython brings both
    import micropython  # type: ignore[no-redef]

MAJOR = 1
"""Ends with different major versions cannot work together."""
MINOR = 0
"""Grows with fields that are appended and kinds that are added, which an older end ignores."""

# From the board
HELLO = 0x01
RX = 0x02
TX_DONE = 0x03
TX_LATE = 0x04
STATUS = 0x05
REFUSED = 0x06

# From the host
ASK_HELLO = 0x41
CONFIG = 0x42
TX_AT = 0x43
RX_ON = 0x44
ASK_STATUS = 0x45

BODY_AT = 2
"""Where a record's body begins, after kind and number."""
RX_FRAME_AT = 13
TX_FRAME_AT = 7
MAX_FRAME_BYTES = 127

HELLO_BYTES = 21
STATUS_BYTES = 36
CONFIG_BYTES = 13
"""Lengths of whole records, kind and number included."""

NOT_MEASURED = -32768
"""A measured value that the board does not have."""
NO_VOLTAGE = 0xFFFF

CAN_TRANSMIT = 0x01
"""Capability in HELLO."""
IS_CONFIGURED = 0x01
IS_RECEIVING = 0x02
HAS_FRAME_WAITING = 0x04
"""Bits of the state in STATUS."""

LATE_FOR_RADIO = 1
LATE_BUSY = 2
LATE_NOT_READY = 3
"""Why a frame was not sent: it was too late, another one waits, or the radio is not configured."""

REFUSED_SETTING = 1
REFUSED_MALFORMED = 2
REFUSED_RADIO = 3
"""Why a command was refused."""

RATE_KHZ = 63_897_600
COUNTER_BITS = 40
COUNT_MASK = 0x3FFF_FFFF
"""Counters wrap at 30 bits, so that they stay small integers in MicroPython."""

MAX_RECORD_BYTES = 250
"""With its check: one block of COBS, with space for later versions."""


@micropython.viper
def crc16(data: ptr8, end: int) -> int:
    """CRC-16/IBM-3740 of ``data[:end]``: x¹⁶ + x¹² + x⁵ + 1 from 0xFFFF; 0 over what ends with its own."""
    crc = 0xFFFF
    at = 0
    while at < end:
        step = (crc >> 8) ^ data[at]
        step ^= step >> 4
        crc = ((crc << 8) ^ (step << 12) ^ (step << 5) ^ step) & 0xFFFF
        at += 1
    return crc


@micropython.viper
def stuff(data: ptr8, end: int, out: ptr8) -> int:
    """Write ``data[:end]`` without zeros into ``out`` (COBS), and a 0 after it; return how many bytes that is."""
    code_at = 0
    code = 1
    fill = 1
    at = 0
    while at < end:
        byte = data[at]
        at += 1
        if byte != 0:
            out[fill] = byte
            fill += 1
            code += 1
        if byte == 0 or (code == 255 and at < end):
            out[code_at] = code
            code_at = fill
            fill += 1
            code = 1
    out[code_at] = code
    out[fill] = 0
    return fill + 1


@micropython.viper
def unstuff(data: ptr8, end: int, out: ptr8) -> int:
    """Inverse of ``stuff`` for ``data[:end]`` without zeros; return the length, -1 where a block lacks its end."""
    at = 0
    fill = 0
    while at < end:
        code = int(data[at])
        stop = at + code
        if stop > end:
            return -1
        at += 1
        while at < stop:
            out[fill] = data[at]
            fill += 1
            at += 1
        if code != 255 and at < end:
            out[fill] = 0
            fill += 1
    return fill


@micropython.viper
def copy(source: ptr8, at: int, end: int, out: ptr8, fill: int) -> int:
    """Copy ``source[at:end]`` to ``out[fill:]``; return where it ends there."""
    while at < end:
        out[fill] = source[at]
        at += 1
        fill += 1
    return fill


@micropython.viper
def copy_to_zero(source: ptr8, at: int, end: int, out: ptr8, fill: int) -> int:
    """Copy ``source[at:end]`` up to its first zero to ``out[fill:]``; return where that is, else ``end``."""
    while at < end and source[at] != 0:
        out[fill] = source[at]
        at += 1
        fill += 1
    return at


@micropython.viper
def write_number(value: int, size: int, out: ptr8, fill: int) -> int:
    """Write a number of up to 32 bits to ``out[fill:]``, little-endian; return where it ends there."""
    while size > 0:
        out[fill] = value & 0xFF
        fill += 1
        value >>= 8
        size -= 1
    return fill


def unsigned(record: bytearray, at: int, size: int) -> int:
    """Little-endian number of ``size`` bytes."""
    value = 0
    while size > 0:
        size -= 1
        value = value << 8 | record[at + size]
    return value


class Writer:
    """Writes records; each method returns the length of what is then in ``line``, ready to be sent."""

    def __init__(self) -> None:
        self.line = bytearray(MAX_RECORD_BYTES + 3)
        self._record = bytearray(MAX_RECORD_BYTES)
        self._fill = 0
        self._number = 0

    def begin(self, kind: int) -> None:
        """Start a record."""
        self._record[0] = kind
        self._record[1] = self._number
        self._number = (self._number + 1) & 0xFF
        self._fill = BODY_AT

    def append(self, value: int, size: int) -> None:
        """Append a number, negative ones as their complement."""
        self._fill = write_number(value, size, self._record, self._fill)

    def append_bytes(self, source: bytearray | memoryview, at: int, end: int) -> None:
        """Append ``source[at:end]``."""
        self._fill = copy(source, at, end, self._record, self._fill)

    def end(self) -> int:
        """Finish a record: check, stuffing, 0."""
        crc = crc16(self._record, self._fill)
        self._record[self._fill] = crc >> 8
        self._record[self._fill + 1] = crc & 0xFF
        length: int = stuff(self._record, self._fill + 2, self.line)
        return length

    def hello(self, firmware: tuple[int, int, int], device_id: bytearray, capabilities: int) -> int:
        """Identity of the board; ``device_id`` has 8 bytes."""
        self.begin(HELLO)
        self.append(MAJOR, 1)
        self.append(MINOR, 1)
        for part in firmware:
            self.append(part, 1)
        self.append_bytes(device_id, 0, 8)
        self.append(RATE_KHZ, 4)
        self.append(COUNTER_BITS, 1)
        self.append(capabilities, 1)
        return self.end()

    def rx(
        self,
        ticks: bytearray | memoryview,
        rx_power_cdbm: int,
        first_path_cdbm: int,
        offset_ppb: int,
        frame: bytearray | memoryview,
        frame_end: int,
    ) -> int:
        """A frame ``frame[:frame_end]``, its stamp, powers in 0.01 dBm, the sender's carrier offset in 1e-9."""
        self.begin(RX)
        self.append_bytes(ticks, 0, 5)
        self.append(rx_power_cdbm, 2)
        self.append(first_path_cdbm, 2)
        self.append(offset_ppb, 2)
        self.append_bytes(frame, 0, frame_end)
        return self.end()

    def tx_done(self, dx: bytearray, ticks: bytearray | memoryview) -> int:
        """The frame of ``dx`` has left with this 5-byte TX stamp."""
        self.begin(TX_DONE)
        self.append_bytes(dx, 0, 5)
        self.append_bytes(ticks, 0, 5)
        return self.end()

    def tx_late(self, dx: bytearray, reason: int) -> int:
        """The frame of ``dx`` was not sent."""
        self.begin(TX_LATE)
        self.append_bytes(dx, 0, 5)
        self.append(reason, 1)
        return self.end()

    def status(
        self,
        ticks: bytearray | memoryview,
        state: int,
        counts: list[int],
        temperature_cc: int = NOT_MEASURED,
        millivolts: int = NO_VOLTAGE,
    ) -> int:
        """Counter now, state, and ``counts``: received, errors, sent, late, garbled commands, records not sent."""
        self.begin(STATUS)
        self.append_bytes(ticks, 0, 5)
        self.append(state, 1)
        for count in counts:
            self.append(count & COUNT_MASK, 4)
        self.append(temperature_cc, 2)
        self.append(millivolts, 2)
        return self.end()

    def refused(self, kind: int, reason: int) -> int:
        """A command of that kind was refused."""
        self.begin(REFUSED)
        self.append(kind, 1)
        self.append(reason, 1)
        return self.end()

    def ask(self, kind: int) -> int:
        """A command without parameters: ``ASK_STATUS`` or ``RX_ON``; and ``ASK_HELLO``, which states our version."""
        self.begin(kind)
        if kind == ASK_HELLO:
            self.append(MAJOR, 1)
            self.append(MINOR, 1)
        return self.end()

    def config(self, tx_antenna_delay: int, rx_antenna_delay: int) -> int:
        """Channel 5, 64 MHz PRF, 6.8 Mbit/s, preamble of 128 symbols with code 9; antenna delays in ticks."""
        self.begin(CONFIG)
        self.append(5, 1)
        self.append(64, 1)
        self.append(2, 1)
        self.append(9, 1)
        self.append(128, 2)
        self.append(tx_antenna_delay, 2)
        self.append(rx_antenna_delay, 2)
        self.append(0, 1)
        return self.end()

    def tx_at(self, dx: bytearray, frame: bytearray, frame_end: int) -> int:
        """Send ``frame[:frame_end]`` so that its RMARKER leaves the radio at the 5-byte ``dx``."""
        self.begin(TX_AT)
        self.append_bytes(dx, 0, 5)
        self.append_bytes(frame, 0, frame_end)
        return self.end()


class Reader:
    """Finds the records in a stream of bytes that may hold anything.

    ``record[:length]`` is the one that ``read`` found, without its check; ``length`` is 0 where it found none.
    ``garbled`` counts stretches between two zeros that are no record, ``overlong`` those that no record can be.
    """

    def __init__(self) -> None:
        self.record = bytearray(MAX_RECORD_BYTES + 2)
        self.length = 0
        self.garbled = 0
        self.overlong = 0
        self._line = bytearray(MAX_RECORD_BYTES + 2)
        self._fill = 0
        self._skipping = False

    def read(self, data: bytearray, at: int, end: int) -> int:
        """Process ``data[at:end]`` up to the end of the next record; return where that is."""
        self.length = 0
        while at < end:
            free = len(self._line) - self._fill
            limit = end if end - at <= free else at + free
            stop = copy_to_zero(data, at, limit, self._line, self._fill)
            self._fill += stop - at
            at = stop
            if at < limit or (at < end and data[at] == 0):
                at += 1
                self._finish()
                if self.length > 0:
                    return at
            elif self._fill == len(self._line):
                if not self._skipping:
                    self.overlong += 1
                    self._skipping = True
                self._fill = 0
        return at

    def _finish(self) -> None:
        """Check whether the bytes before a zero are a record."""
        fill = self._fill
        self._fill = 0
        if self._skipping:
            self._skipping = False
        elif fill > 0:
            size = unstuff(self._line, fill, self.record)
            if size < BODY_AT + 2 or crc16(self.record, size) != 0:
                self.garbled += 1
            else:
                self.length = size - 2
