"""Frames of other systems that share the channel, built from what is published of their formats."""

import struct

import pytest
from protocol1_strategies import FULL

from skyless.core.air.frame import Malformed, fcs
from skyless.core.protocol1.beacon import decode, encode

LONG_ADDRESSES = 0xDC41
SHORT_ADDRESSES = 0x8841


def bitcraze_mac(sender, payload):
    """Header of 21 bytes with 64-bit addresses, sent to everyone."""
    address = bytes((sender, 0, 0, 0, 0, 0, 0xCF, 0xBC))
    return struct.pack("<HBH", LONG_ADDRESSES, 7, 0xBCCF) + bytes((0xFF, *address[1:])) + address + payload


def short_mac(sender, payload):
    """The header that a beacon has, in front of somebody else's payload."""
    return struct.pack("<HBHHH", SHORT_ADDRESSES, 7, 0xBCCF, 0xFFFF, sender) + payload


def tdoa2(anchor):
    stamps = [1000 * other + anchor for other in range(8)]
    return struct.pack("<B8B8I8H", 0x22, *range(8), *stamps, *[33_000] * 8)


def tdoa3(anchor, count):
    head = struct.pack("<BBIB", 0x30, 42, 0xDEADBEEF, count)
    entries = [struct.pack("<BBIH", other, 0x80 | other, 99 * other, 32_900) for other in range(count)]
    return head + b"".join(entries) + bytes((anchor,))


PAYLOADS = {
    "TDoA2": tdoa2(3),
    "TDoA2 with position": tdoa2(3) + b"\xf0\x01" + struct.pack("<fff", 1.0, 2.0, 3.0),
    "TDoA3": tdoa3(3, 5),
    "TDoA3 alone": tdoa3(3, 0),
    "TDoA3 with position": tdoa3(3, 6) + b"\xf0\x01" + struct.pack("<fff", 1.0, 2.0, 3.0),
}


@pytest.mark.parametrize("payload", PAYLOADS.values(), ids=PAYLOADS)
@pytest.mark.parametrize("mac", [bitcraze_mac, short_mac])
def test_bitcraze_frames_are_not_beacons(mac, payload):
    frame = mac(3, payload)
    assert decode(frame + fcs(frame)) is Malformed.NOT_A_BEACON


def test_short_frames_of_the_standard_are_not_beacons():
    acknowledgment = b"\x02\x00\x6a"
    blink = b"\xc5\x07" + bytes(range(8))
    for frame in (acknowledgment, blink):
        assert decode(frame + fcs(frame)) is Malformed.NOT_A_BEACON


@pytest.mark.parametrize("length", range(5, 128))
def test_a_silent_channel_read_as_zeros_is_not_a_beacon(length):
    # The CRC of zeros is zero: such bytes pass the FCS.
    assert decode(bytes(length)) is Malformed.NOT_A_BEACON


def test_another_site_is_still_a_beacon():
    # Telling sites apart is the listener's task: the codec gives the site.
    assert decode(encode(FULL)).site == FULL.site
