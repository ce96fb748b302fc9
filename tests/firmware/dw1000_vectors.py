"""Runs in MicroPython and in CPython alike: what the driver says on the bus to a chip that answers by a script.

Each line is one transaction, or a result; the test compares both interpreters' lines with each other and with its own.
"""

import sys

sys.path.insert(0, sys.argv[1])
import dw1000

OTP = {0x04: 0x28, 0x06: 0x0A0B0C0D, 0x07: 0x01020304, 0x08: 0x7D, 0x09: 0x86, 0x1E: 0x11}


def text(data):
    return "".join(f"{byte:02x}" for byte in data)


class ScriptedBus(dw1000.Bus):
    """Registers that answer what was put in, SYS_STATUS cleared by writing ones; every transaction is kept."""

    def __init__(self, wired=True):
        self.log = []
        self.files = {}
        self.wired = wired
        self.locks = True
        self.after_start = b"\x02\0\0\0\0"
        self.after_off = b"\x02\0\0\0\0"
        self.put(0x00, 0, dw1000.DEVICE_ID)

    def content(self, file):
        return self.files.setdefault(file, bytearray(0x2900 if file == 0x2E else 0x100))

    def put(self, file, sub, data):
        for at, byte in enumerate(data):
            self.content(file)[sub + at] = byte

    def say(self, line):
        self.log.append(line)

    def take(self):
        lines, self.log = self.log, []
        return lines

    @staticmethod
    def place(head):
        file = head[0] & 0x3F
        if not head[0] & 0x40:
            return file, 0, 1
        if not head[1] & 0x80:
            return file, head[1], 2
        return file, head[1] & 0x7F | head[2] << 7, 3

    def transfer(self, out, into):
        file, sub, size = self.place(out)
        assert not out[0] & 0x80 and len(out) == len(into) and not any(out[size:])
        self.say(f"r {text(out[:size])} {len(out) - size}")
        for at in range(size, len(out)):
            into[at] = self.content(file)[sub + at - size]

    def write(self, header, data):
        file, sub, size = self.place(header)
        assert header[0] & 0x80 and len(header) == size
        self.say("w " + text(header) + " " + text(data))
        if file == 0x0F:
            for at, byte in enumerate(data):
                self.content(file)[sub + at] &= ~byte & 0xFF
            return
        self.put(file, sub, data)
        if file == 0x0D and data[0] & 0x06:
            self.put(0x0F, 0, self.after_start)
        if file == 0x0D and data[0] & 0x40:
            self.put(0x0F, 0, self.after_off)
        if file == 0x2D and sub == 0x06 and data[0] & 2:
            word = OTP.get(self.files[0x2D][4], 0)
            self.put(0x2D, 0x0A, word.to_bytes(4, "little"))
        if file == 0x36 and sub == 0 and bytes(data) == b"\x00\x02" and self.locks:
            self.put(0x0F, 0, b"\x02\x00\x80\x03\x00")

    def slow(self):
        self.say("slow")

    def fast(self):
        self.say("fast")

    def reset(self):
        self.say("reset")
        return self.wired

    def pause_us(self, microseconds):
        self.say(f"pause {microseconds}")


def started():
    bus = ScriptedBus()
    chip = dw1000.DW1000(bus)
    chip.start(16436, 0x4042)
    return bus, chip


def script_frame(bus, frame):
    """A frame that has come, with values for which the test knows the answers."""
    bus.put(0x11, 0, frame)
    bus.put(0x10, 0, bytes((len(frame), 0xC8, 0x66, 0x07)))  # RXPACC 0x076 = 118
    bus.put(0x12, 0, b"\x30\x00" + b"\x10\x27" + b"\x20\x28" + b"\x50\x46")  # F2 10000, F3 10272, CIR_PWR 18000
    bus.put(0x15, 0, b"\xfe\xff\xff\x12\xff" + b"\x00\x2e" + b"\x08\x25" + bytes(5))  # F1 9480
    bus.put(0x27, 0x28, b"\x00\xf0\xff\x00\x76\x00")  # -4096; NOSAT 118: 5 symbols of SFD
    bus.put(0x14, 0, b"\x0c\xff\x07")
    bus.put(0x0F, 0, b"\x03\x6f\x00\x00\x00")


def show(name, lines):
    for line in lines:
        print(name, line)


def show_received(chip, name="got"):
    print(name, text(chip.rx_ticks), text(chip.frame[: chip.frame_bytes]), chip.received, chip.errors)
    print(name, chip.rx_power_cdbm, chip.first_path_cdbm, chip.carrier_integrator, chip.offset_ppb)


def show_start():
    bus, chip = started()
    show("start", bus.take())
    print("state", chip.state, text(chip.identity), text(bus.content(0x0F)[:5]))
    chip.receive()
    show("listen", bus.take())
    chip.measure()
    show("measure", bus.take())
    print("measured", chip.temperature_cc, chip.millivolts)
    print("now", text(chip.now()), chip.state)
    chip.stop()
    show("stop", bus.take())


def show_frames():
    bus, chip = started()
    chip.receive()
    bus.take()
    print("quiet", chip.poll(), bus.take())
    for size in (12, 127):
        script_frame(bus, bytes(range(size)))
        print("poll", chip.poll())
        show("rx", bus.take())
        show_received(chip)
    print("tracked", chip.track())
    chip.correct_bias = True
    script_frame(bus, bytes(range(9)))
    print("corrected", chip.poll(), text(chip.rx_ticks))
    chip.measuring = False
    bus.take()
    script_frame(bus, bytes(range(9)))
    print("short", chip.poll(), bus.take())
    print("untold", chip.rx_power_cdbm, chip.first_path_cdbm, chip.offset_ppb)


def show_transmissions():
    bus, chip = started()
    chip.receive()
    bus.take()
    frame, dx = bytearray(range(100, 240)), bytearray(b"\xff\xff\xab\xcd\xef")
    print("queued", chip.transmit_at(dx, frame, 3, 3 + 20), chip.state)
    show("tx", bus.take())
    print("busy", chip.transmit_at(dx, frame, 0, 20), bus.take())
    print("waiting", chip.poll(), bus.take())
    bus.put(0x17, 0, b"\x34\x3e\xac\xcd\xef")
    bus.put(0x0F, 0, b"\xf3\x00\x00\x00\x00")
    print("sent", chip.poll(), text(chip.tx_ticks), chip.sent, chip.state)
    show("done", bus.take())
    for name, status in (("late", b"\x02\0\0\x08\0"), ("unready", b"\x02\0\0\0\x04"), ("gone", b"\x82\0\0\0\x04")):
        bus.after_start = status
        print(name, chip.transmit_at(dx, frame, 0, 127), chip.state, chip.late)
        show(name, bus.take()[6:])
        bus.put(0x0F, 0, b"\x83\0\0\0\0")
        chip.poll()
        bus.take()
    bus.after_start, bus.after_off = b"\x02\0\0\0\x04", b"\x82\0\0\0\0"
    print("race", chip.transmit_at(dx, frame, 0, 3), chip.state, chip.late, chip.poll(), chip.sent)


def show_errors():
    bus, chip = started()
    chip.receive()
    for at, bits in ((1, 0x10), (1, 0x80), (2, 0x01), (2, 0x02), (2, 0x04), (2, 0x10), (2, 0x20), (3, 0x04), (3, 0x20)):
        status = bytearray(b"\x03\x03\0\0\0")
        status[at] |= bits
        bus.put(0x0F, 0, status)
        bus.take()
        print("failed", at, bits, chip.poll(), chip.errors, chip.state)
        show("failed", bus.take())
    bus.put(0x0F, 0, b"\x03\x4b\0\0\0")
    print("no search", chip.poll(), chip.errors, len(bus.take()))
    bus.put(0x0F, 0, b"\x02\0\0\x02\0")
    print("slip", chip.poll(), bus.take())
    bus.put(0x0F, 0, b"\0\0\0\0\0")
    print("still there", chip.poll(), chip.state)
    bus.put(0x1F, 0, bytes(4))
    print("lost", chip.poll(), chip.state, chip.poll(), chip.transmit_at(bytearray(5), bytearray(9), 0, 9))


def show_refusals():
    for wired, device, locks in ((False, b"\xff\xff\xff\xff", True), (True, dw1000.DEVICE_ID, False)):
        bus = ScriptedBus(wired)
        bus.put(0, 0, device)
        bus.locks = locks
        try:
            dw1000.DW1000(bus).start(0, 0)
        except dw1000.ChipError as error:
            print("refused", error, len(bus.log), bus.log[:4])
    bus, chip = started()
    for size in (0, 2, 128):
        try:
            chip.transmit_at(bytearray(5), bytearray(200), 0, size)
        except ValueError as error:
            print("refused", size, error)


def show_numbers():
    for value in (1, 2, 3, 1000, 32767, 32768, 65535, 65536, 1 << 29, (1 << 30) - 1):
        print("log", value, dw1000.log10(value, dw1000.LOG10_TABLE))
    for power in range(-10500, -5000, 77):
        print("bias", power, dw1000.bias_ticks(power))
    for value in (-60000, -57170, -4096, -1, 0, 1, 35000, 57170):
        print("carrier", value, dw1000.carrier_offset_ppb(value), dw1000.clock_offset_ppb(value // 64))
    print("none", dw1000.power_cdbm(0, 118), dw1000.power_cdbm(9, 0), dw1000.first_path_cdbm(0, 0, 0, 9))
    print("accumulated", [dw1000.accumulated(symbols) for symbols in (-5, 0, 1, 113, 4095)])


class QuietBus(dw1000.Bus):
    """Allocates nothing: a chip for which each look at SYS_STATUS shows what is set, and that counts what passes."""

    def __init__(self):
        self.status = 0x02
        self.status_1 = 0
        self.status_3 = 0
        self.transactions = 0
        self.octets = 0

    def transfer(self, out, into):
        self.transactions += 1
        self.octets += len(out)
        if out[0] == 0x0F:
            into[1] = self.status
            into[2] = self.status_1
            into[4] = self.status_3
        elif out[0] == 0x10:
            into[1] = 100
            into[3] = 0x60
            into[4] = 0x07
        elif out[0] == 0x12:
            into[7] = into[8] = 0xFF
            into[3] = into[4] = into[5] = into[6] = 0xFF
        elif out[0] == 0x15:
            into[8] = into[9] = 0xFF
        elif out[0] == 0x67:
            into[2] = into[3] = into[4] = 0xFF

    def write(self, header, data):
        self.transactions += 1
        self.octets += len(header) + len(data)

    def pause_us(self, microseconds):
        pass


def pass_frames(chip, bus, dx, frame, now, rounds):
    """Frames received and sent, late, taken back, and lost to an error; a clock that slips."""
    total = 0
    for _ in range(rounds):
        bus.status, bus.status_1 = 0x03, 0x6F
        total += chip.poll() + chip.frame_bytes + chip.rx_power_cdbm + chip.track()
        bus.status, bus.status_1 = 0x03, 0x90
        total += chip.poll()
        bus.status, bus.status_1 = 0x02, 0
        total += dw1000.micros_until(chip.now(), dx)
        total += chip.transmit_at(dx, frame, 7, 100)
        bus.status = 0x83
        total += chip.poll()
        bus.status = 0x02
        total += chip.transmit_at(dx, frame, 0, 127) + chip.cancel()
        bus.status_3 = 0x08
        total += chip.transmit_at(dx, frame, 0, 3)
        bus.status_3 = 0x02
        total += chip.poll()
        bus.status_3 = 0
    return total


def show_no_allocation():
    bus = QuietBus()
    chip = dw1000.DW1000(bus)
    chip.state = dw1000.IDLE
    chip.receive()
    chip.correct_bias = True
    dx, frame, now = bytearray(b"\0\xff\x80\xff\xff"), bytearray(range(127)), chip.now()
    print("passed", pass_frames(chip, bus, dx, frame, now, 3), chip.received, chip.sent, chip.errors, chip.late)
    bus.transactions = bus.octets = 0
    bus.status, bus.status_1 = 0x03, 0x6F
    chip.poll()
    print("received in", bus.transactions, "transactions", bus.octets, "octets")
    bus.transactions = bus.octets = 0
    bus.status, bus.status_1 = 0x02, 0
    chip.transmit_at(dx, frame, 0, 100)
    print("handed over in", bus.transactions, "transactions", bus.octets, "octets")
    bus.transactions = bus.octets = 0
    bus.status = 0x83
    chip.poll()
    print("finished in", bus.transactions, "transactions", bus.octets, "octets")
    if sys.implementation.name == "micropython":
        import gc

        import micropython

        gc.collect()
        gc.disable()
        before = gc.mem_alloc()
        micropython.heap_lock()
        try:
            pass_frames(chip, bus, dx, frame, now, 50)
        finally:
            micropython.heap_unlock()
        print("allocated", gc.mem_alloc() - before, file=sys.stderr)


if __name__ == "__main__":
    show_start()
    show_frames()
    show_transmissions()
    show_errors()
    show_refusals()
    show_numbers()
    show_no_allocation()
