"""PosiStageNet 2, for media servers and lighting consoles: frames of all tags at a steady rate, names once a second.

A packet consists of chunks, ``number u16 | length 15 bits, highest bit: holds chunks | data``, little-endian; metres.
Source: PosiStageNet protocol 2.03 (https://posistage.net).
"""

import asyncio
import re
import struct
import time
from collections import Counter
from typing import Final, cast

from msgspec import Struct

from skyless.bridges._senders import UdpSender
from skyless.bridges.target import UPS, BridgeContext, BridgedSite, Target, TargetUrl, Up, turned
from skyless.run.mqtt.messages import FixMessage, Vector

GROUP: Final = "236.10.10.10"
GROUP_PORT: Final = 56_565
FRAMES_HZ: Final = 60.0
"""Usual rate of frames."""

VERSION: Final = (2, 3)
DATA_PACKET: Final = 0x6755
INFO_PACKET: Final = 0x6756
HEADER: Final = 0
DATA_TRACKERS: Final = 1
INFO_SYSTEM_NAME: Final = 1
INFO_TRACKERS: Final = 2
INFO_TRACKER_NAME: Final = 0
POSITION: Final = 0
SPEED: Final = 1
TRACKER_STATUS: Final = 3
TIMESTAMP: Final = 6

_HOLDS_CHUNKS: Final = 0x8000
_CHUNK_BYTES: Final = 4
_HEADER_BYTES: Final = 12
MAX_PACKET_BYTES: Final = 1472
"""A packet with its UDP and IP headers fits an Ethernet frame."""
MAX_PACKETS: Final = 255
"""Packets of one frame; a byte counts them."""
MAX_TRACKERS: Final = 0xFFFF

_LAST_NUMBER: Final = re.compile(r"(\d{1,5})$")


class Tracker(Struct):
    """What is known of one tag."""

    number: int
    position_m: Vector | None = None
    """None while there is no fix."""
    velocity_mps: Vector | None = None
    unix_s: float = 0.0
    """Time of the fix."""


class PsnFrames:
    """Trackers, and the packets that state them. Does no I/O and reads no clock."""

    def __init__(self, start_unix_s: float, up: Up = "y") -> None:
        """Stamps are the time since ``start_unix_s``, in µs."""
        self._start_unix_s = start_unix_s
        self._up = up
        self._name = b""
        self._trackers: dict[str, Tracker] = {}
        self._frame = 0
        self.dropped: Counter[str] = Counter()

    def on_site(self, site: BridgedSite) -> None:
        """Its name is the system's."""
        self._name = site.name.encode()[:255].decode(errors="ignore").encode()

    def on_fix(self, fix: FixMessage) -> None:
        """The tag's position from now on."""
        tracker = self._tracker(fix.tag)
        if tracker is None:
            return
        velocity = fix.velocity_mps
        if not all(abs(value) < 3e38 for value in (*fix.position_m, *(velocity or ()))):  # what a 32-bit float holds
            self.dropped["psn-value"] += 1
            return
        tracker.position_m = turned(fix.position_m, self._up)
        tracker.velocity_mps = None if velocity is None else turned(velocity, self._up)
        tracker.unix_s = fix.unix_s

    def on_no_fix(self, tag: str) -> None:
        """The tag has no position from now on."""
        tracker = self._tracker(tag)
        if tracker is not None:
            tracker.position_m = tracker.velocity_mps = None

    def data_packets(self, unix_s: float) -> list[bytes]:
        """One frame: all trackers; those without a fix have status 0 and no position. Nothing while there is none."""
        known = sorted(self._trackers.values(), key=lambda tracker: tracker.number)
        trackers = [_chunk(tracker.number, self._data(tracker), holds_chunks=True) for tracker in known]
        self._frame = (self._frame + 1) & 0xFF
        return self._packets(DATA_PACKET, b"", DATA_TRACKERS, trackers, unix_s)

    def info_packets(self, unix_s: float) -> list[bytes]:
        """The system's name and the trackers' names."""
        numbers = {tracker.number: name for name, tracker in self._trackers.items()}
        trackers = [
            _chunk(number, _chunk(INFO_TRACKER_NAME, numbers[number].encode()), holds_chunks=True)
            for number in sorted(numbers)
        ]
        return self._packets(INFO_PACKET, _chunk(INFO_SYSTEM_NAME, self._name), INFO_TRACKERS, trackers, unix_s)

    def _tracker(self, tag: str) -> Tracker | None:
        """A tag whose name ends with a number has that number, if it is free; the others have the lowest free one."""
        tracker = self._trackers.get(tag)
        if tracker is None:
            used = {tracker.number for tracker in self._trackers.values()}
            if len(used) >= MAX_TRACKERS:
                self.dropped["psn-trackers"] += 1
                return None
            found = _LAST_NUMBER.search(tag)
            number = int(found[1]) if found else 0
            if not 0 < number <= MAX_TRACKERS or number in used:
                number = next(free for free in range(1, MAX_TRACKERS + 1) if free not in used)
            tracker = self._trackers[tag] = Tracker(number)
        return tracker

    def _data(self, tracker: Tracker) -> bytes:
        if tracker.position_m is None:
            return _chunk(TRACKER_STATUS, struct.pack("<f", 0.0))
        chunks = [_chunk(POSITION, struct.pack("<3f", *tracker.position_m))]
        if tracker.velocity_mps is not None:
            chunks.append(_chunk(SPEED, struct.pack("<3f", *tracker.velocity_mps)))
        chunks.append(_chunk(TRACKER_STATUS, struct.pack("<f", 1.0)))
        chunks.append(_chunk(TIMESTAMP, struct.pack("<Q", self._stamp_us(tracker.unix_s))))
        return b"".join(chunks)

    def _stamp_us(self, unix_s: float) -> int:
        return max(0, round((unix_s - self._start_unix_s) * 1e6)) & 0xFFFF_FFFF_FFFF_FFFF

    def _packets(self, kind: int, before: bytes, list_number: int, trackers: list[bytes], unix_s: float) -> list[bytes]:
        """Divide the trackers among packets that fit."""
        if not trackers:
            return []  # readers stumble over empty lists
        space = MAX_PACKET_BYTES - 3 * _CHUNK_BYTES - _HEADER_BYTES - len(before)
        groups: list[list[bytes]] = [[]]
        for tracker in trackers:
            if groups[-1] and sum(map(len, groups[-1])) + len(tracker) > space:
                groups.append([])
            groups[-1].append(tracker)
        if len(groups) > MAX_PACKETS:
            self.dropped["psn-packets"] += len(groups) - MAX_PACKETS
            del groups[MAX_PACKETS:]
        stamp = struct.pack("<QBBBB", self._stamp_us(unix_s), *VERSION, self._frame, len(groups))
        return [
            _chunk(
                kind,
                _chunk(HEADER, stamp) + before + _chunk(list_number, b"".join(group), holds_chunks=True),
                holds_chunks=True,
            )
            for group in groups
        ]


def _chunk(number: int, data: bytes, *, holds_chunks: bool = False) -> bytes:
    return struct.pack("<HH", number, len(data) | (_HOLDS_CHUNKS if holds_chunks else 0)) + data


class PsnTarget(Target):
    """Sends frames at a steady rate, as PosiStageNet's readers expect."""

    def __init__(self, text: str, sender: UdpSender, frames_hz: float, up: Up) -> None:
        super().__init__(text)
        self._sender = sender
        self._interval_s = 1.0 / frames_hz
        self._frames = PsnFrames(time.time(), up)
        self.dropped = self._frames.dropped = sender.dropped

    def on_site(self, site: BridgedSite) -> None:
        """Its name is sent once a second."""
        self._frames.on_site(site)

    def on_fix(self, fix: FixMessage) -> None:
        """It is in the next frame."""
        self._frames.on_fix(fix)

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> None:  # noqa: ARG002 - no field for them
        """The tag is in the next frame without a position."""
        self._frames.on_no_fix(tag)

    def on_second(self, unix_s: float) -> None:
        """Names."""
        self._send(self._frames.info_packets(unix_s))

    async def run(self) -> None:
        """Send frames until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._sender.run())
            group.create_task(self._send_frames())

    async def _send_frames(self) -> None:
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            self._send(self._frames.data_packets(time.time()))
            due_s = max(due_s + self._interval_s, loop.time())
            await asyncio.sleep(due_s - loop.time())

    def _send(self, packets: list[bytes]) -> None:
        for packet in packets:
            self._sender.send(packet)


def make_target(url: TargetUrl, context: BridgeContext) -> PsnTarget:
    """Keys: ``hz``, frames per second; ``up``, the axis that points up; ``interface``, the network card to leave by.

    Raises:
        SkylessError: one of them is not right.
    """
    up = cast(Up, url.choice("up", UPS, "y"))
    frames_hz = url.number("hz", FRAMES_HZ, 1.0, 200.0)
    host, port = url.host(GROUP), url.port(GROUP_PORT)
    sender = UdpSender(url.text, host, port, context.log, interface=url.text_option("interface"))
    return PsnTarget(url.text, sender, frames_hz, up)
