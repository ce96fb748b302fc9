"""Runs in MicroPython alone: the nRF52832's UART and SPI on registers that are arrays; prints what the test asks."""

import array
import gc
import sys

sys.path.insert(0, sys.argv[1])
sys.path.insert(0, sys.argv[2])
import micropython
import nrf52
import uctypes

uarte, timer, ppi, clock = (array.array("I", [0] * 0x200) for _ in range(4))
pauses = []


def word(registers, offset):
    return registers[offset // 4]


def address(buffer):
    return uctypes.addressof(buffer) & 0xFFFF_FFFF


uart = nrf52.Uarte(pauses.append, uarte, timer, ppi, clock)
print("crystal", clock[0], sum(clock))
print("pins", word(uarte, 0x50C), word(uarte, 0x514), hex(word(uarte, 0x508)), hex(word(uarte, 0x510)))
print("line", hex(word(uarte, 0x524)), word(uarte, 0x56C), word(uarte, 0x500), hex(word(uarte, 0x308)))
print("ring", word(uarte, 0x534) == address(uart._ring), word(uarte, 0x538), word(uarte, 0x200), word(uarte, 0x000))
print("timer", word(timer, 0x504), word(timer, 0x508), word(timer, 0x00C), word(timer, 0x000))
print("route", word(ppi, 0x548) == address(uarte) + 0x108, word(ppi, 0x54C) == address(timer) + 8, word(ppi, 0x504))


# Receiving: the DMA writes, the timer counts
class Line:
    count, place = 0, 0


into = bytearray(64)


def arrive(size):
    for _ in range(size):
        uart._ring[Line.place] = Line.count & 0xFF
        Line.place = (Line.place + 1) % 255
        Line.count = (Line.count + 1) & 0xFFFF_FFFF
    timer[0x540 // 4] = Line.count


def fetch():
    got = []
    while True:
        size = uart.read(into)
        if size == 0:
            return got
        got.extend(into[:size])


total, right = 0, True
for size in (0, 1, 63, 64, 65, 200, 255, 254, 3, 255, 255):
    arrive(size)
    got = fetch()
    right = right and got == [(total + at) & 0xFF for at in range(size)]
    total += size
print("received", total, right)
arrive(256)
print("overrun", fetch(), uart.overruns)
arrive(7)
print("after", len(fetch()), uart._at == Line.place)
Line.count = nrf52.COUNT_MASK - 20 + (1 << 30)  # the timer runs on where the count wraps
uart._read_count = Line.count & nrf52.COUNT_MASK
arrive(60)
print("wrapped", len(fetch()), uart.overruns)

# Sending
out = bytearray()


def fly():
    """The DMA sends what it was told to, and says so."""
    begin = word(uarte, 0x544) - address(uart._out)
    size = word(uarte, 0x548)
    assert word(uarte, 0x120) == 0 and 0 < size <= 255 and begin + size <= nrf52.OUT_BYTES
    out.extend(uart._out[begin : begin + size])
    uarte[0x008 // 4] = 0
    uarte[0x120 // 4] = 1


line = bytearray((7 * number + 1) & 0xFF for number in range(252))
wanted, refused = bytearray(), 0
for number in range(200):
    end = (number * 37) % 252 + 1
    if uart.write(line, end):
        wanted.extend(line[:end])
    else:
        refused += 1
    if number % 3 == 0 and word(uarte, 0x008):
        fly()
        uart.read(into)
while word(uarte, 0x008):
    fly()
    uart.read(into)
print("sent", out == wanted, len(out) > 4000, refused > 0, uart._held)
uart.write(line, 100)
uart.restart()
print("restart", uart._held, uart._sending, word(uarte, 0x00C), pauses)


# SPI
class Pin:
    IN, OUT = 0, 1

    def __init__(self, name):
        self.name = name

    def __call__(self, value):
        log.append((self.name, value))

    def init(self, mode, value=None):
        log.append((self.name, "out" if mode else "in", value))


class Spi:
    """Answers with the complement."""

    def write_readinto(self, out, into):
        assert len(out) == len(into) >= 2
        for at in range(len(out)):
            into[at] = ~out[at] & 0xFF
        log.append(bytes(out))

    def init(self, baudrate, polarity, phase):
        log.append((baudrate, polarity, phase))


log = []
bus = nrf52.SpiBus(Spi(), Pin("cs"), Pin("rst"), log.append)
bus.slow()
bus.reset()
bus.fast()
back = bytearray(3)
bus.transfer(memoryview(b"\x0f\0\0"), memoryview(back))
bus.write(memoryview(b"\x8d"), memoryview(b"\x40"))
bus.write(memoryview(b"\xee\x84\x30"), memoryview(b"\x34\x40"))
print("spi", log, back)


def work():
    for _ in range(200):
        timer[0x540 // 4] = timer[0x540 // 4] + 40
        uart.read(into)
        uart.write(line, 120)
        uarte[0x120 // 4] = 1
        nrf52.received(timer)


class QuietSpi:
    def write_readinto(self, out, into):
        pass


def write_all():
    for _ in range(50):
        bus.write(head, short)
        bus.write(head, long)
        bus.transfer(long, long)


head, short, long = memoryview(bytearray(3)), memoryview(bytearray(1)), memoryview(bytearray(128))
timer[0x540 // 4] = 0
uart.restart()
bus = nrf52.SpiBus(QuietSpi(), lambda value: None, None, None)
work()
write_all()
gc.collect()
gc.disable()
before = gc.mem_alloc()
micropython.heap_lock()
work()
write_all()
micropython.heap_unlock()
print("allocated", gc.mem_alloc() - before)
