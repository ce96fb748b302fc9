"""Bytes of captures, written here from the descriptions of the formats and not by the code under test."""

import base64
import struct


def tdoa3(sequence, tx_ticks, relays, position_m=None):
    """``relays``: (anchor, sequence, rx_ticks, distance or None)."""
    payload = bytes([0x30, sequence]) + struct.pack("<I", tx_ticks) + bytes([len(relays)])
    for anchor, heard, rx_ticks, distance in relays:
        payload += bytes([anchor, heard | (0 if distance is None else 0x80)]) + struct.pack("<I", rx_ticks)
        if distance is not None:
            payload += struct.pack("<H", distance)
    return payload + lpp(position_m)


def tdoa2(sequences, stamps, distances, position_m=None):
    body = bytes([0x22]) + bytes(sequences) + struct.pack("<8I", *stamps) + struct.pack("<8H", *distances)
    return body + lpp(position_m)


def lpp(position_m):
    return b"" if position_m is None else b"\xf0\x01" + struct.pack("<3f", *position_m)


def binary_record(sender, rx_ticks, payload):
    length = struct.pack("<H", len(payload))
    return b"\xbc" + rx_ticks.to_bytes(5, "little") + bytes([sender, 255]) + length + payload + length


def text_line(sender, rx_ticks, payload):
    return b"From %02x to ff @%010x: %s\r\n" % (sender, rx_ticks, payload.hex().encode())


def yaml_document(sender, rx_ticks, payload, host_s=1700000000.25):
    data = base64.b64encode(payload).decode()
    wrapped = "".join(f"  {data[at : at + 76]}\n" for at in range(0, len(data), 76))
    rest = f"from: {sender}\nremoteCount: 0\nrxSys: {host_s}\nseq: 1\nto: 255\nts: {rx_ticks}\ntype: 48\n"
    return f"---\ndata: !!binary |\n{wrapped}{rest}\n".encode()
