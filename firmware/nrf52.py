"""UART and SPI of an nRF52832 as a board needs them, for MicroPython alone. It has never run on a chip.

The port's own ``machine.UART`` waits until a record is out, 1.2 ms for a long one, and holds 64 bytes that came in
meanwhile: too slow for slots of 2.1 ms. Here both directions go through EasyDMA: the receiver fills a ring of 255
bytes repeatedly (short ENDRX to STARTRX), and a timer counts the bytes (PPI from RXDRDY to COUNT). Offsets of
registers are those of the nRF52832 Product Specification, compared with the tables of NuttX.
"""

import dw1000
import link
import micropython
from micropython import const

CLOCK = 0x4000_0000
UARTE0 = 0x4000_2000
TIMER3 = 0x4001_A000
PPI = 0x4001_F000
TX_PIN = 5
RX_PIN = 11

RING_BYTES = 255
"""The greatest RXD.MAXCNT of this chip: 8 bits."""
OUT_BYTES = 1024
COUNT_MASK = 0x3FFF_FFFF
"""Counts stay small integers."""
FAST_HZ = 8_000_000
SLOW_HZ = 2_000_000
MAX_WRITE_BYTES = 131
"""Header and data of the longest write."""

# Offsets in words of 32 bits. CLOCK:
_HFCLKSTART = const(0x000 // 4)
# UARTE:
_STARTRX = const(0x000 // 4)
_STOPRX = const(0x004 // 4)
_STARTTX = const(0x008 // 4)
_STOPTX = const(0x00C // 4)
_ENDTX = const(0x120 // 4)
_SHORTS = const(0x200 // 4)
_INTENCLR = const(0x308 // 4)
_ENABLE = const(0x500 // 4)
_PSEL_RTS = const(0x508 // 4)
_PSEL_TXD = const(0x50C // 4)
_PSEL_CTS = const(0x510 // 4)
_PSEL_RXD = const(0x514 // 4)
_BAUDRATE = const(0x524 // 4)
_RXD_PTR = const(0x534 // 4)
_RXD_MAXCNT = const(0x538 // 4)
_TXD_PTR = const(0x544 // 4)
_TXD_MAXCNT = const(0x548 // 4)
_CONFIG = const(0x56C // 4)
# TIMER:
_START = const(0x000 // 4)
_STOP = const(0x004 // 4)
_CLEAR = const(0x00C // 4)
_CAPTURE0 = const(0x040 // 4)
_MODE = const(0x504 // 4)
_BITMODE = const(0x508 // 4)
_CC0 = const(0x540 // 4)
# PPI, channel 7:
_CHENSET = const(0x504 // 4)
_CHENCLR = const(0x508 // 4)
_CH7_EEP = const((0x510 + 7 * 8) // 4)
_CH7_TEP = const((0x514 + 7 * 8) // 4)


@micropython.viper
def stop(uarte: ptr32, timer: ptr32, ppi: ptr32):  # noqa: ANN201, F821 - viper's types
    """Stop the UART, whatever used it: no interrupts, no transfer."""
    uarte[_INTENCLR] = -1
    uarte[_SHORTS] = 0
    uarte[_STOPRX] = 1
    uarte[_STOPTX] = 1
    timer[_STOP] = 1
    ppi[_CHENCLR] = 1 << 7


@micropython.viper
def start(uarte: ptr32, timer: ptr32, ppi: ptr32, ring: ptr8, clock: ptr32):  # noqa: ANN201, F821
    """1 Mbaud by the crystal, 8N1, no flow control, receiving into the ring, every byte counted."""
    clock[_HFCLKSTART] = 1
    uarte[_ENABLE] = 0
    uarte[_PSEL_RTS] = -1
    uarte[_PSEL_CTS] = -1
    uarte[_PSEL_TXD] = 5
    uarte[_PSEL_RXD] = 11
    uarte[_BAUDRATE] = 0x10000000
    uarte[_CONFIG] = 0
    uarte[_ENABLE] = 8
    timer[_MODE] = 1
    timer[_BITMODE] = 3
    timer[_CLEAR] = 1
    timer[_START] = 1
    ppi[_CH7_EEP] = int(uarte) + 0x108
    ppi[_CH7_TEP] = int(timer) + 0x008
    ppi[_CHENSET] = 1 << 7
    uarte[_RXD_PTR] = int(ring)
    uarte[_RXD_MAXCNT] = 255
    uarte[_SHORTS] = 1 << 5
    uarte[_STARTRX] = 1


@micropython.viper
def received(timer: ptr32) -> int:  # noqa: F821
    """How many bytes were received, modulo 2**30."""
    timer[_CAPTURE0] = 1
    return int(timer[_CC0]) & 0x3FFFFFFF


@micropython.viper
def copy_from_ring(ring: ptr8, at: int, size: int, out: ptr8) -> int:  # noqa: F821
    """Copy ``size`` bytes from the ring; return the index of the next one."""
    fill = 0
    while fill < size:
        out[fill] = ring[at]
        fill += 1
        at += 1
        if at == 255:
            at = 0
    return at


@micropython.viper
def join(header: ptr8, begin: int, data: ptr8, end: int, out: ptr8):  # noqa: ANN201, F821
    """Header of ``begin`` bytes, and data after it up to ``end``."""
    at = 0
    while at < begin:
        out[at] = header[at]
        at += 1
    while at < end:
        out[at] = data[at - begin]
        at += 1


@micropython.viper
def send(uarte: ptr32, data: ptr8, at: int, size: int):  # noqa: ANN201, F821
    """Begin to send ``data[at:at + size]``, which must not change until ``is_sent``."""
    uarte[_ENDTX] = 0
    uarte[_TXD_PTR] = int(data) + at
    uarte[_TXD_MAXCNT] = size
    uarte[_STARTTX] = 1


@micropython.viper
def is_sent(uarte: ptr32) -> bool:  # noqa: F821
    """Whether the last piece is sent."""
    return uarte[_ENDTX] != 0


class Uarte:
    """The serial port (``board.Uart``); registers are given by their addresses."""

    def __init__(self, pause_us, uarte=UARTE0, timer=TIMER3, ppi=PPI, clock=CLOCK):  # noqa: ANN001, ANN204
        self.overruns = 0
        self._uarte, self._timer, self._ppi, self._clock, self._pause_us = uarte, timer, ppi, clock, pause_us
        self._ring, self._out = bytearray(RING_BYTES), bytearray(OUT_BYTES)
        self._begin, self._held, self._sending = 0, 0, 0
        self.restart()

    def restart(self):  # noqa: ANN201
        """Restart; what was being sent is cut off, and what waits is sent after it."""
        stop(self._uarte, self._timer, self._ppi)
        self._pause_us(200)
        start(self._uarte, self._timer, self._ppi, self._ring, self._clock)
        self._read_count, self._at = received(self._timer), 0
        self._drop(self._sending)

    def read(self, into):  # noqa: ANN001, ANN201
        """Read what was received, and keep sending. Overwritten bytes are missing, which the records' check shows."""
        if self._held > 0:
            self._pump()
        fresh = (received(self._timer) - self._read_count) & COUNT_MASK
        if fresh == 0:
            return 0
        if fresh > RING_BYTES:
            self.overruns += 1
            self._at = (self._at + fresh) % RING_BYTES
            self._read_count = (self._read_count + fresh) & COUNT_MASK
            return 0
        size = min(len(into), fresh)
        self._at = copy_from_ring(self._ring, self._at, size, into)
        self._read_count = (self._read_count + size) & COUNT_MASK
        return size

    def write(self, line, end):  # noqa: ANN001, ANN201
        """Queue ``line[:end]``; False where it does not fit."""
        if end > OUT_BYTES - self._held:
            return False
        fill = (self._begin + self._held) % OUT_BYTES
        first = min(OUT_BYTES - fill, end)
        link.copy(line, 0, first, self._out, fill)
        if first < end:
            link.copy(line, first, end, self._out, 0)
        self._held += end
        self._pump()
        return True

    def _pump(self):  # noqa: ANN202
        """Send the next piece when one is sent."""
        if self._sending > 0:
            if not is_sent(self._uarte):
                return
            self._drop(self._sending)
        if self._held > 0:
            size = min(OUT_BYTES - self._begin, self._held, 255)
            self._sending = size
            send(self._uarte, self._out, self._begin, size)

    def _drop(self, size):  # noqa: ANN001, ANN202
        self._begin = (self._begin + size) % OUT_BYTES
        self._held -= size
        self._sending = 0


class SpiBus(dw1000.Bus):
    """The chip's bus.

    Header and data of a write go out in one transfer of two octets or more: where one octet is sent and received, this
    processor's SPI sends two (its anomaly 58).
    """

    def __init__(self, spi, select, reset_pin, pause_us):  # noqa: ANN001, ANN204
        """Pins are ``machine.Pin``; the reset pin must not drive the line yet."""
        self._spi, self._select, self._reset, self.pause_us = spi, select, reset_pin, pause_us
        self._exchange = spi.write_readinto
        self._out, self._into = bytearray(MAX_WRITE_BYTES), bytearray(MAX_WRITE_BYTES)
        self._outs, self._intos = [None] * (MAX_WRITE_BYTES + 1), [None] * (MAX_WRITE_BYTES + 1)

    def transfer(self, out, into):  # noqa: ANN001, ANN201
        """Both directions at once."""
        self._select(0)
        self._exchange(out, into)
        self._select(1)

    def write(self, header, data):  # noqa: ANN001, ANN201
        """What comes back is ignored. Slices are made when a length is first used, and kept."""
        begin = len(header)
        end = begin + len(data)
        join(header, begin, data, end, self._out)
        out = self._outs[end]
        if out is None:
            out = self._outs[end] = memoryview(self._out)[:end]
            self._intos[end] = memoryview(self._into)[:end]
        self._select(0)
        self._exchange(out, self._intos[end])
        self._select(1)

    def slow(self):  # noqa: ANN201
        """Below 3 MHz."""
        self._spi.init(baudrate=SLOW_HZ, polarity=0, phase=0)

    def fast(self):  # noqa: ANN201
        """The maximum of this processor; that of the chip is 20 MHz."""
        self._spi.init(baudrate=FAST_HZ, polarity=0, phase=0)

    def reset(self):  # noqa: ANN201
        """Low for a moment, then let go: the chip pulls it up."""
        self._reset.init(self._reset.OUT, value=0)
        self.pause_us(100)
        self._reset.init(self._reset.IN)
        return True
