"""Runs in MicroPython and in CPython alike: one line for each vector, which the test compares."""

import sys

sys.path.insert(0, sys.argv[1])
import link


def show(name, data, end):
    print(name, "".join(f"{byte:02x}" for byte in data[:end]))


def exercise(writer, reader, ticks, frame, counts):
    """One record of each kind that a board handles in every slot, there and back."""
    total = 0
    for number in range(4):
        if number == 0:
            end = writer.rx(ticks, -7953, -8312, -31234, frame, 127)
        elif number == 1:
            end = writer.tx_done(ticks, ticks)
        elif number == 2:
            end = writer.status(ticks, 3, counts)
        else:
            end = writer.tx_at(ticks, frame, 100)
        reader.read(writer.line, 0, end)
        total += reader.length + link.unsigned(reader.record, 2, 2) + link.unsigned(reader.record, 7, 2)
    return total


def main():
    writer, reader = link.Writer(), link.Reader()
    ticks, frame = bytearray(b"\x00\xff\x80\x01\xfe"), bytearray(range(127))
    counts = [0, 1, 255, 65536, 0x3FFFFFFF, 0x40000001]
    print("crc", link.crc16(b"123456789", 9))
    for end in (0, 1, 2, 126, 127):
        show("rx", writer.line, writer.rx(ticks, -7953, link.NOT_MEASURED, 32767, frame, end))
        show("tx_at", writer.line, writer.tx_at(ticks, frame, end))
    show("hello", writer.line, writer.hello((1, 2, 3), bytearray(b"\x00identit"), 1))
    show("done", writer.line, writer.tx_done(ticks, ticks))
    show("late", writer.line, writer.tx_late(ticks, 1))
    show("status", writer.line, writer.status(ticks, 3, counts, -512, 3300))
    show("refused", writer.line, writer.refused(link.CONFIG, 1))
    show("config", writer.line, writer.config(16436, 0x4042))
    for kind in (link.ASK_HELLO, link.RX_ON, link.ASK_STATUS):
        show("ask", writer.line, writer.ask(kind))
    mess = bytearray((number * number * 31 + number) & 0xFF for number in range(5000))
    place = 700
    for kind in (link.RX_ON, link.ASK_STATUS, link.ASK_HELLO):
        end = writer.ask(kind)
        mess[place] = 0
        for number in range(end):
            mess[place + 1 + number] = writer.line[number]
        place += 1500
    at, found = 0, []
    while at < len(mess):
        at = reader.read(mess, at, min(at + 97, len(mess)))
        if reader.length:
            found.append(reader.record[0])
    print("found", found, reader.garbled, reader.overlong)
    total = exercise(writer, reader, ticks, frame, counts)
    print("total", total)
    if sys.implementation.name == "micropython":
        import gc

        gc.collect()
        gc.disable()
        before = gc.mem_alloc()
        for _ in range(10):
            exercise(writer, reader, ticks, frame, counts)
        print("allocated", gc.mem_alloc() - before, file=sys.stderr)


main()
