"""Recordings of every format, of a made-up room: what its anchors and its listener would have written down.

Eight anchors at the corners of 8 m × 6 m × 3 m send in turn, 2 ms apart; the tag goes round in a circle, or stands
still. Each clock has its own rate and offset; stamps have 100 ps of Gaussian noise. Written from the descriptions of
the formats, not with the code under test, in a stream, so that a file may be of any length.
"""

import json
from itertools import product
from math import cos, dist, sin
from random import Random
from struct import pack
from zlib import crc32

from support.capture_makers import binary_record, tdoa3, text_line, yaml_document

C_MPS = 299_702_547.0  # in air, as the radios of these systems assume
RATE_HZ = 499.2e6 * 128
ANCHORS_M = dict(enumerate(product((0.0, 8.0), (0.0, 6.0), (0.2, 2.8)), start=1))
NOISE_S = 100e-12
PERIOD_S = 0.002
TAG = 0x99
PPM = {anchor: (-1) ** anchor * 1.7 * anchor for anchor in ANCHORS_M} | {TAG: 4.0}


def anchors_csv():
    return "id,x_m,y_m,z_m\n" + "".join(f"{n},{x},{y},{z}\n" for n, (x, y, z) in ANCHORS_M.items())


def place_m(t_s, speed_mps=0.5):
    """Where the tag is: on a circle of 1.5 m about the middle, 1.2 m high."""
    angle = speed_mps * t_s / 1.5
    return 4.0 + 1.5 * cos(angle), 3.0 + 1.5 * sin(angle), 1.2


def truth_csv(until_s, speed_mps=0.5):
    rows = (k * 0.05 for k in range(int(until_s / 0.05) + 2))
    lines = ("{:.3f},{:.5f},{:.5f},{:.5f}\n".format(t, *place_m(t, speed_mps)) for t in rows)
    return "t_s,x_m,y_m,z_m\n" + "".join(lines)


def stamp(clock, t_s, random, bits=40):
    offset = clock * 777_777_777
    return (round((t_s + random.gauss(0.0, NOISE_S)) * RATE_HZ * (1 + PPM[clock] * 1e-6)) + offset) % 2**bits


def tdoa_rows(count, seed=1, speed_mps=0.5, noise_m=0.1):
    """(t_s, a, b, tdoa_m), one every 2 ms."""
    random = Random(seed)
    names = list(ANCHORS_M)
    for k in range(count):
        t = k * PERIOD_S
        a, b = random.sample(names, 2)
        tag = place_m(t, speed_mps)
        yield t, a, b, dist(tag, ANCHORS_M[b]) - dist(tag, ANCHORS_M[a]) + random.gauss(0.0, noise_m)


def tdoa_table(count, **options):
    yield b"t_s,idA,idB,tdoa_m\n"
    for t, a, b, tdoa_m in tdoa_rows(count, **options):
        yield b"%.6f,%d,%d,%.5f\n" % (t, a, b, tdoa_m)


def packets(count, seed=1, speed_mps=0.5):
    """(host_s, sender, rx_ticks, payload) of TDoA3, each with what its sender heard since it sent before."""
    random = Random(seed)
    names = list(ANCHORS_M)
    heard = {anchor: {} for anchor in names}
    for k in range(count):
        sender, t = names[k % len(names)], 1.0 + k * PERIOD_S
        sequence = k // len(names) % 128
        relays = [(anchor, *told) for anchor, told in heard[sender].items()]
        heard[sender] = {}
        payload = tdoa3(sequence, stamp(sender, t, random, 32), relays)
        flight_s = dist(place_m(k * PERIOD_S, speed_mps), ANCHORS_M[sender]) / C_MPS
        yield 1.7e9 + t, sender, stamp(TAG, t + flight_s, random), payload
        for other in names:
            if other != sender:
                flight_s = dist(ANCHORS_M[sender], ANCHORS_M[other]) / C_MPS
                rx_ticks = stamp(other, t + flight_s, random, 32)
                heard[other][sender] = (sequence, rx_ticks, round(flight_s * RATE_HZ))


def yaml_capture(count, **options):
    for host_s, sender, rx_ticks, payload in packets(count, **options):
        yield yaml_document(sender, rx_ticks, payload, host_s)


def binary_stream(count, **options):
    for _, sender, rx_ticks, payload in packets(count, **options):
        yield binary_record(sender, rx_ticks, payload)


def text_stream(count, **options):
    for _, sender, rx_ticks, payload in packets(count, **options):
        yield text_line(sender, rx_ticks, payload)


def avalue_table(count, seed=1, speed_mps=0.5):
    """The anchors hear each other and the listener, node 99, hears them all: ``count`` transmissions."""
    random = Random(seed)
    names = list(ANCHORS_M)
    yield b"t_host,order,slave,master,status,tx_ticks_u40,rx_ticks_u40\n"
    for k in range(count):
        sender, t = names[k % len(names)], 1.0 + k * PERIOD_S
        tx_ticks = stamp(sender, t, random)
        places = {TAG: place_m(k * PERIOD_S, speed_mps)} | ANCHORS_M
        for other, place in places.items():
            if other != sender:
                rx_ticks = stamp(other, t + dist(place, ANCHORS_M[sender]) / C_MPS, random)
                yield b"%.6f,%d,%X,%X,0,%d,%d\n" % (1.7e9 + t, k // len(names), other, sender, tx_ticks, rx_ticks)


def miluv_table(count, seed=1, speed_mps=0.5):
    """Exchanges of three messages, 5 ms each, that the tag overhears, with the truth."""
    random = Random(seed)
    yield (
        b"t_s,listener,initiator,responder,L_rx1,L_rx2,L_rx3,I_tx1,R_rx1,R_tx2,I_rx2,R_tx3,I_rx3,"
        b"gt_L_x_m,gt_L_y_m,gt_L_z_m,gt_I_x_m,gt_I_y_m,gt_I_z_m,gt_R_x_m,gt_R_y_m,gt_R_z_m\n"
    )
    for k in range(count):
        first, t = random.sample(list(ANCHORS_M), 2), k * 0.005
        numbers = exchange_stamps(*first, 1.0 + t, place_m(t, speed_mps), random)
        where = [*place_m(t, speed_mps), *ANCHORS_M[first[0]], *ANCHORS_M[first[1]]]
        fields = [f"{t:.6f}", TAG, *first, *numbers, *(f"{value:.5f}" for value in where)]
        yield ",".join(map(str, fields)).encode() + b"\n"


def exchange_stamps(i, r, t, tag_m, random):
    """The nine stamps of one exchange in the order of the table."""

    def at(clock, sender, sent_s):
        place = tag_m if clock == TAG else ANCHORS_M[clock]
        return stamp(clock, sent_s + dist(place, ANCHORS_M[sender]) / C_MPS, random, 32)

    t2, t3 = t + 0.0006, t + 0.0026
    listened = [at(TAG, i, t), at(TAG, r, t2), at(TAG, r, t3)]
    return [*listened, at(i, i, t), at(r, i, t), at(r, r, t2), at(i, r, t2), at(r, r, t3), at(i, r, t3)]


def dl_tdoa_rounds(count, seed=1, speed_mps=0.5):
    """Rounds of FiRa's DL-TDoA, nine messages each, in dicts; anchor 1 is the initiator, and sends the final one."""
    random = Random(seed)
    for number in range(-(-count // 9)):
        sent, replies, messages = 1.0 + number * 9 * PERIOD_S, {}, []
        final_s = sent + 8 * PERIOD_S
        tx_poll, tx_final = stamp(1, sent, random), stamp(1, final_s, random)
        for k, anchor in enumerate([*ANCHORS_M, 1]):
            t, kind = sent + k * PERIOD_S, 0 if k == 0 else 2 if k == 8 else 1
            flight_s = dist(ANCHORS_M[anchor], ANCHORS_M[1]) / C_MPS
            tx = {0: tx_poll, 2: tx_final}.get(kind) or stamp(anchor, t, random)
            reply = (tx - stamp(anchor, sent + flight_s, random)) % 2**40 if kind == 1 else 0
            if kind == 1:
                replies[anchor] = (tx_final - stamp(1, t + flight_s, random)) % 2**40
            heard_s = t + dist(place_m(t - 1.0, speed_mps), ANCHORS_M[anchor]) / C_MPS
            flight = round(flight_s * RATE_HZ) if kind == 1 else 0
            messages.append((anchor, kind, number % 2**16, tx, stamp(TAG, heard_s, random), reply, flight))
        whole = [(*message, replies.get(message[0], 0) if message[1] == 1 else 0) for message in messages]
        yield whole[: count - 9 * number]


def uci_notification(messages, number):
    """A round as measurements of version 1, with relative locations, in segments."""
    body = pack("<IIBIBBB8xB", number, 7, 0, 200, 2, 0, 0, len(messages))
    for anchor, kind, block, tx, rx, reply, flight, initiator_reply in messages:
        body += pack("<HBBHHBBhBhBB", anchor, 0, kind, 2 << 5, block, 0, 0, 0, 0, 0, 0, 160)
        body += tx.to_bytes(5, "little") + rx.to_bytes(5, "little")
        body += pack("<hhIIH", -32768, -32768, initiator_reply, reply, flight) + location(ANCHORS_M[anchor])
    parts = [body[at : at + 255] for at in range(0, len(body), 255)]
    ends = [0x72] * (len(parts) - 1) + [0x62]
    return [bytes((end, 0, 0, len(part))) + part for end, part in zip(ends, parts, strict=True)]


def location(position_m):
    """x, y of 28 bits and z of 24 bits in millimetres, lowest byte first, one string of bits."""
    x, y, z = (round(1000 * value) for value in position_m)
    digits = [f"{value & 255:08b}" for value in (x, x >> 8, x >> 16)] + [f"{x >> 24 & 15:04b}"]
    digits += [f"{value & 255:08b}" for value in (y, y >> 8, y >> 16)] + [f"{y >> 24 & 15:04b}"]
    digits += [f"{value & 255:08b}" for value in (z, z >> 8, z >> 16)]
    return int("".join(digits), 2).to_bytes(10, "big")


def uci_binary(count, **options):
    for number, messages in enumerate(dl_tdoa_rounds(count, **options)):
        yield b"".join(uci_notification(messages, number))


def uci_text(count, **options):
    for number, messages in enumerate(dl_tdoa_rounds(count, **options)):
        for segment in uci_notification(messages, number):
            yield b"11-21 10:00:%06.3f UciHal: RECV %s\n" % (number % 60, segment.hex(" ").encode())


def phone_records(count, **options):
    """As an app on Android could write them."""
    for messages in dl_tdoa_rounds(count, **options):
        for anchor, kind, block, tx, rx, reply, flight, initiator_reply in messages:
            x, y, z = (round(1000 * value) for value in ANCHORS_M[anchor])
            record = {
                "address": f"00:{anchor:02x}",
                "messageType": kind,
                "messageControl": 0,
                "blockIndex": block,
                "roundIndex": 0,
                "txTimestamp": [byte - 256 if byte > 127 else byte for byte in tx.to_bytes(8, "little")],
                "rxTimestamp": rx.to_bytes(8, "little").hex(),
                "responderReplyTime": reply,
                "initiatorReplyTime": initiator_reply,
                "initiatorResponderTof": flight,
                "anchorLocation": {"coordinateType": 1, "relativeLocation": {"x": x, "y": y, "z": z}},
            }
            yield json.dumps(record).encode() + b"\n"


MAKERS = {
    "tdoa-table": tdoa_table,
    "bitcraze-yaml": yaml_capture,
    "bitcraze-binary": binary_stream,
    "bitcraze-text": text_stream,
    "avalue": avalue_table,
    "miluv": miluv_table,
    "uci-binary": uci_binary,
    "uci-text": uci_text,
    "dl-tdoa-json": phone_records,
}
LISTENER = {"avalue": ["--listener", "0x99"]}


def write(path, name, count, **options):
    """Write a recording of a format and return its path."""
    with path.open("wb") as file:
        file.writelines(MAKERS[name](count, **options))
    return path


CRAZYFLIE_KINDS = {
    5: ("estTDOA", ("idA(B)", "idB(B)", "distanceDiff(f)")),
    6: ("estTdoaCand", ("idA(B)", "idB(B)", "distanceDiff(f)")),
    7: ("estPose", tuple(f"locSrv.{name}(f)" for name in ("x", "y", "z", "qx", "qy", "qz", "qw"))),
    9: ("estTOF", ("range.zrange(H)",)),
    10: ("estBarometer", ("baro.asl(f)",)),
}


def crazyflie_log(events, version=2, kinds=CRAZYFLIE_KINDS):
    """A log of a Crazyflie's SD card, of events (number, seconds, values)."""
    data = b"\xbc" + pack("<HH", version, len(kinds))
    for number, (name, fields) in kinds.items():
        data += pack("<H", number) + name.encode() + b"\0" + pack("<H", len(fields))
        data += b"".join(field.encode() + b"\0" for field in fields)
    for number, time_s, values in events:
        types = "".join(field[-2] for field in kinds[number][1])
        head = pack("<HI", number, round(1e3 * time_s)) if version == 1 else pack("<HQ", number, round(1e6 * time_s))
        data += head + pack("<" + types, *values)
    return data + pack("<I", crc32(data))


def pcapng(*packets, order="<"):
    """A capture of UCI packets, in either order of bytes."""

    def block(kind, body):
        body += b"\0" * (-len(body) % 4)
        return pack(order + "II", kind, len(body) + 12) + body + pack(order + "I", len(body) + 12)

    capture = block(0x0A0D0D0A, pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1))
    capture += block(1, pack(order + "HHI", 299, 0, 0))
    for packet in packets:
        capture += block(6, pack(order + "IIIII", 0, 0, 0, len(packet), len(packet)) + packet)
    return capture
