"""Runs in MicroPython and in CPython alike: a board on the driver, a chip that a script plays, its host on a wire.

Each line is what the board said, as hex; the test compares both interpreters' lines, and reads them itself.
"""

import sys

sys.path.insert(0, sys.argv[1])
import board

dw1000, link = board.dw1000, board.link

TICKS_PER_US = 63898
"""Rounded: the stand-in's clock, not the chip's."""
TX_DELAY, RX_DELAY = 16436, 16000
PREAMBLE_US = 138


def text(data):
    return "".join(f"{byte:02x}" for byte in data)


class Clock:
    """Like MicroPython's ``time``, but it passes only when told."""

    def __init__(self):
        self.us = 5_000_000

    def ticks_us(self):
        return self.us & 0x3FFF_FFFF

    def ticks_add(self, ticks, change):
        return (ticks + change) & 0x3FFF_FFFF

    def ticks_diff(self, later, earlier):
        return ((later - earlier + 0x2000_0000) & 0x3FFF_FFFF) - 0x2000_0000


class Collector:
    """Notes when the garbage was collected."""

    def __init__(self, clock):
        self.clock = clock
        self.at_us = []

    def collect(self):
        self.at_us.append(self.clock.us)
        self.clock.us += 1300


class Wire:
    """A UART: ``inbox`` comes from the host, ``outbox`` goes there. Allocates nothing but in ``take``."""

    def __init__(self):
        self.inbox, self.outbox = bytearray(4096), bytearray(4096)
        self.in_at = self.in_end = self.out_end = 0
        self.restarts = 0

    def read(self, into):
        size = 0
        while size < len(into) and self.in_at < self.in_end:
            into[size] = self.inbox[self.in_at]
            size += 1
            self.in_at += 1
        if self.in_at == self.in_end:
            self.in_at = self.in_end = 0
        return size

    def write(self, line, end):
        if self.out_end + end > len(self.outbox):
            return False
        self.out_end = link.copy(line, 0, end, self.outbox, self.out_end)
        return True

    def restart(self):
        self.restarts += 1
        self.in_at = self.in_end = 0

    def put(self, line, end):
        """The host sends."""
        self.in_end = link.copy(line, 0, end, self.inbox, self.in_end)

    def take(self):
        """What the board has sent."""
        said, self.out_end = bytes(self.outbox[: self.out_end]), 0
        return said


class ChipBus(dw1000.Bus):
    """As much of a DW1000 as the board can tell: counter, status, one frame each way. Also its interrupt line."""

    def __init__(self, clock):
        self.clock = clock
        self.status = bytearray(5)
        self.frame = bytearray(130)
        self.frame_bytes = 0
        self.channel = bytearray(4)
        self.rx_stamp = bytearray(5)
        self.tx_stamp = bytearray(5)
        self.sent = bytearray(130)
        self.sent_bytes = 0
        self.dx = 0
        self.leaves_us = -1
        self.listening = False
        self.never_tells = False
        self.present = True
        self.transactions = 0

    def value(self):
        return 1 if self.status[0] & 0x80 or self.status[1] & 0xD0 or self.status[2] & 0x37 else 0

    def fly(self):
        """What happens by itself."""
        if self.leaves_us >= 0 and self.clock.us >= self.leaves_us:
            self.leaves_us = -1
            stamp = (self.dx & ~0x1FF) + TX_DELAY
            for at in range(5):
                self.tx_stamp[at] = stamp >> 8 * at & 0xFF
            if not self.never_tells:
                self.status[0] |= 0xF0

    def hear(self, frame, end, ticks):
        """A frame comes in; False where the receiver is off or the last one is still there."""
        if not self.listening or self.status[1] & 0x40:
            return False
        link.copy(frame, 0, end, self.frame, 0)
        self.frame_bytes = end
        for at in range(5):
            self.rx_stamp[at] = ticks >> 8 * at & 0xFF
        self.status[1] |= 0x6F
        return True

    def transfer(self, out, into):
        self.transactions += 1
        self.fly()
        file = out[0] & 0x3F
        size = len(out)
        for at in range(1, size):
            into[at] = 0
        if not self.present:
            return
        if file == 0x00:
            self.give(dw1000.DEVICE_ID, into, 4)
        elif file == 0x0F:
            self.give(self.status, into, 5)
        elif file == 0x06:
            ticks = self.clock.us * TICKS_PER_US
            for at in range(5):
                into[1 + at] = ticks >> 8 * at & 0xFF
            into[1] = 0
            into[2] &= 0xFE
        elif file == 0x10:
            into[1], into[3], into[4] = self.frame_bytes, 0x60, 0x07
        elif file == 0x11:
            self.give(self.frame, into, size - 1)
        elif file == 0x12:
            into[3], into[4], into[5], into[6], into[7], into[8] = 0x10, 0x27, 0x20, 0x28, 0x50, 0x46
        elif file == 0x15:
            self.give(self.rx_stamp, into, 5)
            into[8], into[9] = 0x08, 0x25
        elif file == 0x17:
            self.give(self.tx_stamp, into, 5)
        elif file == 0x1F:
            self.give(self.channel, into, 4)
        elif file == 0x27:
            into[2 + 1], into[2 + 2] = 0xF0, 0xFF

    @staticmethod
    def give(source, into, size):
        link.copy(source, 0, size, into, 1)

    def write(self, header, data):
        self.transactions += 1
        self.fly()
        file = header[0] & 0x3F
        if file == 0x0F:
            for at in range(len(data)):
                self.status[at] &= ~data[at] & 0xFF
        elif file == 0x09:
            self.sent_bytes = link.copy(data, 0, len(data), self.sent, 0)
        elif file == 0x08 and len(data) == 4:
            self.length = data[0] & 0x7F
        elif file == 0x1F:
            link.copy(data, 0, 4, self.channel, 0)
        elif file == 0x0A:
            self.dx = 0
            for at in range(5):
                self.dx |= data[at] << 8 * at
        elif file == 0x0D:
            self.control(data)
        elif file == 0x36 and len(header) == 1 and data[0] == 0 and data[1] == 2:
            self.status[0] |= 0x02

    def control(self, data):
        if data[0] & 0x40:
            self.leaves_us = -1
            self.listening = False
        if data[0] & 0x06:
            left = (self.dx // TICKS_PER_US) - self.clock.us
            if left < PREAMBLE_US:
                self.status[3] |= 0x08
                left += 17_207_400
            self.leaves_us = self.clock.us + left
        if len(data) > 1 and data[1] & 0x01:
            self.listening = True

    def slow(self):
        pass

    def fast(self):
        pass

    def reset(self):
        for at in range(5):
            self.status[at] = 0
        link.copy(self.status, 0, 4, self.channel, 0)
        self.listening = False
        self.leaves_us = -1
        return True

    def pause_us(self, microseconds):
        self.clock.us += microseconds


class Bench:
    """A board, what it stands on, and a host that writes commands."""

    def __init__(self, can_transmit=True):
        self.clock, self.wire = Clock(), Wire()
        self.bus = ChipBus(self.clock)
        self.chip = dw1000.DW1000(self.bus)
        self.collector = Collector(self.clock)
        identity = bytearray(b"identity")
        self.board = board.Board(
            self.chip, self.wire, self.clock, self.collector, can_transmit, identity, interrupt=self.bus
        )
        self.host = link.Writer()
        self.dx = bytearray(5)

    def say(self, end):
        self.wire.put(self.host.line, end)

    def turn(self, turns=1, step_us=20):
        for _ in range(turns):
            self.bus.fly()
            self.board.turn()
            self.clock.us += step_us

    def ready(self):
        """As a host finds it."""
        self.board.begin()
        self.say(self.host.config(TX_DELAY, RX_DELAY))
        self.say(self.host.ask(link.RX_ON))
        self.turn(4)
        return self

    def tx_at(self, at_us, frame, end):
        """Ask for a frame at a time of the stand-in's clock."""
        ticks = at_us * TICKS_PER_US + 0x155
        for place in range(5):
            self.dx[place] = ticks >> 8 * place & 0xFF
        self.say(self.host.tx_at(self.dx, frame, end))


def show(name, bench):
    print(name, text(bench.wire.take()))


def show_greeting():
    bench = Bench()
    bench.board.begin()
    show("begin", bench)
    for kind in (link.ASK_HELLO, link.ASK_STATUS, link.RX_ON):
        bench.say(bench.host.ask(kind))
        bench.turn()
        show("before", bench)
    bench.say(bench.host.config(TX_DELAY, RX_DELAY))
    bench.turn()
    show("configured", bench)
    bench.say(bench.host.ask(link.RX_ON))
    bench.turn()
    show("receiving", bench)


def show_frames():
    bench = Bench().ready()
    show("ready", bench)
    frame = bytearray(range(127))
    for end in (3, 64, 127):
        bench.bus.hear(frame, end, 0xFE_DCBA_9800 + end)
        bench.turn()
        show("heard", bench)
    for ahead_us in (14_000, 900, 100):
        bench.tx_at(bench.clock.us + ahead_us, frame, 40)
        bench.turn(1000)
        show("sent", bench)
    print("fly", text(bench.bus.sent[:38]), bench.bus.sent_bytes)
    bench.say(bench.host.ask(link.ASK_STATUS))
    bench.turn()
    show("status", bench)


def slot(bench, frame, number):
    """A reception, a frame of its own now and then, the status, noise. What is allocated here is the board's."""
    bench.wire.out_end = 0
    bench.bus.hear(frame, 100, number << 20)
    bench.turn(3)
    if number % 3 == 0:
        bench.tx_at(bench.clock.us + 3000, frame, 100)
        bench.turn(6)
        bench.clock.us += 2000
        bench.turn(100)
    elif number % 3 == 1:
        bench.say(bench.host.ask(link.ASK_STATUS))
        bench.say(bench.host.ask(link.ASK_HELLO))
        bench.wire.put(frame, 90)
        bench.tx_at(bench.clock.us - 3000, frame, 100)
        bench.turn(8)
    else:
        bench.bus.status[2] |= 0x01
        bench.turn(2)


def slots(bench, frame, count):
    for number in range(count):
        slot(bench, frame, number)


def show_no_allocation():
    bench = Bench().ready()
    bench.turn(200)
    frame = bytearray(range(127))
    slots(bench, frame, 12)
    chip = bench.chip
    print("passed", chip.received, chip.sent, chip.errors, chip.late, bench.board.unsent)
    if sys.implementation.name == "micropython":
        import gc

        import micropython

        gc.collect()
        gc.disable()
        before = gc.mem_alloc()
        micropython.heap_lock()
        try:
            slots(bench, frame, 60)
        finally:
            micropython.heap_unlock()
        print("allocated", gc.mem_alloc() - before, file=sys.stderr)
    else:
        slots(bench, frame, 60)
    print("passed", chip.received, chip.sent, chip.errors, chip.late, bench.board.unsent)
    print("chores", bench.board.chores)


if __name__ == "__main__":
    show_greeting()
    show_frames()
    show_no_allocation()
