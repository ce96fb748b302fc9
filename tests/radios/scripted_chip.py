"""A DW1000 that answers by a script, and what the driver sends it: one line for each transaction, or for a result."""

from skyless.radios.dw1000 import driver as dw1000

OTP = {0x04: 0x28, 0x06: 0x0A0B0C0D, 0x07: 0x01020304, 0x08: 0x7D, 0x09: 0x86, 0x1E: 0x11}


def text(data):
    return bytes(data).hex()


def stamp_text(ticks):
    return text(ticks.to_bytes(5, "little"))


class ScriptedBus:
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

    def transfer(self, out):
        file, sub, size = self.place(out)
        if out[0] & 0x80:
            self.write(file, sub, bytes(out[:size]), bytes(out[size:]))
            return bytes(len(out))
        assert not any(out[size:])
        self.say(f"r {text(out[:size])} {len(out) - size}")
        return bytes(size) + bytes(self.content(file)[sub : sub + len(out) - size])

    def write(self, file, sub, header, data):
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
    bus.put(0x0F, 0, b"\x03\x6f\x00\x00\x00")


class QuietBus:
    """A chip for which each look at SYS_STATUS shows what is set, and that counts what passes."""

    def __init__(self):
        self.show(0x02)

    def show(self, status):
        self.status, self.transactions, self.octets = status, 0, 0

    def transfer(self, out):
        self.transactions += 1
        self.octets += len(out)
        answers = {0x0F: self.status.to_bytes(5, "little"), 0x10: b"\x64\0\x60\x07", 0x12: b"\0\0" + b"\xff" * 6}
        return b"\0" + answers.get(out[0], b"").ljust(len(out) - 1, b"\0")

    def pause_us(self, microseconds):
        pass


class Story:
    """Lines by name, of a driver's life on such chips."""

    def __init__(self):
        self.lines = {}
        for part in (self.start, self.frames, self.transmissions, self.errors, self.refusals, self.costs):
            part()

    def note(self, name, *values):
        self.lines.setdefault(name, []).append(" ".join(map(str, values)))

    def show(self, name, lines):
        for line in lines:
            self.note(name, line)

    def received(self, chip):
        self.note("got", stamp_text(chip.rx_ticks), text(chip.frame), chip.received, chip.errors)
        self.note("got", chip.rx_power_cdbm, chip.first_path_cdbm, chip.carrier_integrator, chip.offset_ppb)

    def start(self):
        bus, chip = started()
        self.show("start", bus.take())
        self.note("state", chip.state, text(chip.identity), text(bus.content(0x0F)[:5]))
        chip.receive()
        self.show("listen", bus.take())
        chip.measure()
        self.show("measure", bus.take())
        self.note("measured", chip.temperature_cc, chip.millivolts)
        self.note("now", stamp_text(chip.now()), chip.state)
        chip.stop()
        self.show("stop", bus.take())

    def frames(self):
        bus, chip = started()
        chip.receive()
        bus.take()
        self.note("quiet", chip.poll(), bus.take())
        for size in (12, 127):
            script_frame(bus, bytes(range(size)))
            self.note("poll", chip.poll())
            self.show("rx", bus.take())
            self.received(chip)
        chip.correct_bias = True
        script_frame(bus, bytes(range(9)))
        self.note("corrected", chip.poll(), stamp_text(chip.rx_ticks))
        chip.measuring = False
        bus.take()
        script_frame(bus, bytes(range(9)))
        self.note("short", chip.poll(), bus.take())
        self.note("unmeasured", chip.rx_power_cdbm, chip.first_path_cdbm, chip.offset_ppb)

    def transmissions(self):
        bus, chip = started()
        chip.receive()
        bus.take()
        frame, dx = bytes(range(100, 240)), 0xEFCDABFFFF
        self.note("queued", chip.transmit_at(dx, frame[3:23]), chip.state)
        self.show("tx", bus.take())
        self.note("busy", chip.transmit_at(dx, frame[:20]), bus.take())
        self.note("waiting", chip.poll(), bus.take())
        bus.put(0x17, 0, b"\x34\x3e\xac\xcd\xef")
        bus.put(0x0F, 0, b"\xf3\x00\x00\x00\x00")
        self.note("sent", chip.poll(), stamp_text(chip.tx_ticks), chip.sent, chip.state)
        self.show("done", bus.take())
        for name, status in (("late", b"\x02\0\0\x08\0"), ("unready", b"\x02\0\0\0\x04"), ("gone", b"\x82\0\0\0\x04")):
            bus.after_start = status
            self.note(name, chip.transmit_at(dx, frame[:127]), chip.state, chip.late)
            self.show(name, bus.take()[6:])
            bus.put(0x0F, 0, b"\x83\0\0\0\0")
            chip.poll()
            bus.take()
        bus.after_start, bus.after_off = b"\x02\0\0\0\x04", b"\x82\0\0\0\0"
        self.note("race", chip.transmit_at(dx, frame[:3]), chip.state, chip.late, chip.poll(), chip.sent)

    def errors(self):
        bus, chip = started()
        chip.receive()
        for at, bits in (
            (1, 0x10),
            (1, 0x80),
            (2, 0x01),
            (2, 0x02),
            (2, 0x04),
            (2, 0x10),
            (2, 0x20),
            (3, 0x04),
            (3, 0x20),
        ):
            status = bytearray(b"\x03\x03\0\0\0")
            status[at] |= bits
            bus.put(0x0F, 0, status)
            bus.take()
            self.note("failed", at, bits, chip.poll(), chip.errors, chip.state)
            self.show("failed", bus.take())
        bus.put(0x0F, 0, b"\x03\x4b\0\0\0")
        self.note("no", "search", chip.poll(), chip.errors, len(bus.take()))
        bus.put(0x0F, 0, b"\x02\0\0\x02\0")
        self.note("slip", chip.poll(), bus.take())
        bus.put(0x0F, 0, b"\0\0\0\0\0")
        self.note("still", "there", chip.poll(), chip.state)
        bus.put(0x1F, 0, bytes(4))
        self.note("lost", chip.poll(), chip.state, chip.poll(), chip.transmit_at(0, bytes(9)))

    def refusals(self):
        for wired, device, locks in ((False, b"\xff\xff\xff\xff", True), (True, dw1000.DEVICE_ID, False)):
            bus = ScriptedBus(wired)
            bus.put(0, 0, device)
            bus.locks = locks
            try:
                dw1000.DW1000(bus).start(0, 0)
            except dw1000.ChipError as error:
                self.note("refused", error, len(bus.log), bus.log[:4])
        bus, chip = started()
        for size in (0, 2, 128):
            try:
                chip.transmit_at(0, bytes(size))
            except ValueError as error:
                self.note("refused", size, error)

    def costs(self):
        bus = QuietBus()
        chip = dw1000.DW1000(bus)
        chip.state = dw1000.IDLE
        chip.receive()
        bus.show(0x6F03)
        chip.poll()
        self.note("received", "in", bus.transactions, "transactions", bus.octets, "octets")
        bus.show(0x02)
        chip.transmit_at(0, bytes(100))
        self.note("handed", "over in", bus.transactions, "transactions", bus.octets, "octets")
        bus.show(0x83)
        chip.poll()
        self.note("finished", "in", bus.transactions, "transactions", bus.octets, "octets")
