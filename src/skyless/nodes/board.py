"""``skyless board``: an emulated board, one node of the emulated air behind a pseudo-terminal."""

import json
import math
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final, Literal, Protocol

from skyless.air.beacon import Beacon
from skyless.air.codec import decode_cached
from skyless.air.ieee802154 import is_intact
from skyless.air.reception import Diagnostics, Reception, Transmission
from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_RATE_HZ
from skyless.nodes.process import Log
from skyless.nodes.uci_board import UciProtocol
from skyless.radios.interface import Gone, Hint, Late, Radio, RadioEvent, Restarted, Sent
from skyless.radios.serial import link
from skyless.radios.serial.link_records import to_steps
from skyless.radios.serial.pseudo_terminal import Pty
from skyless.recordings.foreign.bitcraze import TDOA3
from skyless.site.almanac_pages import AlmanacAssembly
from skyless.ticks import wrap

Send = Callable[[bytes], bool]
_EMULATED_FIRMWARE: Final = (0, 0, 0)
_LAST_ID: Final = 0xFF


BoardFormat = Literal["link", "sniffer", "sniffer-text", "listener", "uci", "uci-2"]
RADIO_OF: Final[dict[BoardFormat, str]] = {
    "link": "serial",
    "sniffer": "sniffer",
    "sniffer-text": "sniffer",
    "listener": "listener",
    "uci": "uci",
    "uci-2": "uci",
}
"""The name in ``--radio`` of a board of each format."""


class BoardProtocol(Protocol):
    """What a board sends and understands on its serial line."""

    def on_radio_event(self, event: RadioEvent) -> None:
        """Send the host what happened on the air."""

    def on_host_data(self, data: bytes) -> None:
        """Process bytes from the host."""


class LinkProtocol:
    """The serial link, as the firmware of real boards speaks it (``firmware/source/board.c``)."""

    def __init__(self, radio: Radio, send: Send, *, can_transmit: bool) -> None:
        self._radio, self._send, self._can_transmit = radio, send, can_transmit
        self._reader, self._writer = link.Reader(), link.Writer()
        self._configured = self._receiving = False
        self._tx_delay_ticks = 0
        self._waiting: dict[int, int] = {}
        """dx by TX stamp, of frames that have not left."""
        self.counts = dict.fromkeys(("received", "errors", "sent", "late", "garbled", "unsent"), 0)

    def on_radio_event(self, event: RadioEvent) -> None:
        """Send the records of an event, if the host has asked for them."""
        if isinstance(event, Reception):
            self._report(event)
        elif isinstance(event, Sent | Late):
            dx_ticks = self._waiting.pop(event.tx_ticks, None)
            if dx_ticks is not None and isinstance(event, Sent):
                self.counts["sent"] += 1
                self._write(self._writer.tx_done(dx_ticks, event.tx_ticks))
            elif dx_ticks is not None:
                self._late(dx_ticks, link.LATE_FOR_RADIO)
        elif isinstance(event, Restarted):
            self._configured = self._receiving = False
            self._waiting.clear()
            self._send(b"\0")
            self._hello()

    def _report(self, reception: Reception) -> None:
        if not self._receiving:
            return
        self.counts["received"] += 1
        measured = to_steps(reception.diagnostics or Diagnostics())
        self._write(self._writer.rx(reception.rx_ticks, *measured, reception.frame))

    def on_host_data(self, data: bytes) -> None:
        """Execute commands; a board whose radio is dead does nothing."""
        for record in self._reader.read(data):
            if self._radio.now_ticks() is not None:
                self._execute(record)

    def _execute(self, record: bytes) -> None:
        kind = record[0]
        if kind == link.ASK_HELLO:
            self._hello()
        elif kind == link.ASK_STATUS:
            self._status()
        elif kind == link.CONFIG:
            self._configure(record)
        elif kind == link.RX_ON and self._configured:
            self._receiving = True
            self._status()
        elif kind == link.TX_AT and _is_frame(record[link.TX_FRAME_AT :]):
            dx_ticks = int.from_bytes(record[link.BODY_AT : link.TX_FRAME_AT], "little")
            self._transmit(dx_ticks, record[link.TX_FRAME_AT :])
        elif kind in (link.RX_ON, link.TX_AT):
            self._write(self._writer.refused(kind, link.REFUSED_MALFORMED))
        else:
            self.counts["garbled"] += 1

    def _hello(self) -> None:
        name = self._radio.name.encode()[:8].ljust(8, b"\0")
        self._write(self._writer.hello(_EMULATED_FIRMWARE, name, link.CAN_TRANSMIT if self._can_transmit else 0))

    def _status(self) -> None:
        ticks = self._radio.now_ticks()
        state = self._configured * link.IS_CONFIGURED | self._receiving * link.IS_RECEIVING
        state |= bool(self._waiting) * link.HAS_FRAME_WAITING
        counts = self.counts | {"garbled": self.counts["garbled"] + self._reader.garbled + self._reader.overlong}
        self._write(self._writer.status(ticks or 0, state, list(counts.values())))

    def _configure(self, record: bytes) -> None:
        """Set the antenna delays; the other settings must be those of the air."""
        if len(record) < link.CONFIG_BYTES or record[2:8] != _CONFIG[2:8]:
            reason = link.REFUSED_MALFORMED if len(record) < link.CONFIG_BYTES else link.REFUSED_SETTING
            self._write(self._writer.refused(link.CONFIG, reason))
            return
        self._tx_delay_ticks = int.from_bytes(record[8:10], "little")
        self._configured, self._receiving = True, False
        self._status()

    def _transmit(self, dx_ticks: int, frame: bytes) -> None:
        if not (self._configured and self._can_transmit):
            self._late(dx_ticks, link.LATE_NOT_READY)
        elif self._waiting:
            self._late(dx_ticks, link.LATE_BUSY)
        else:
            tx_ticks = wrap((dx_ticks & ~0x1FF) + self._tx_delay_ticks)
            self._waiting[tx_ticks] = dx_ticks
            self._radio.transmit(Transmission(frame, tx_ticks))

    def _late(self, dx_ticks: int, reason: int) -> None:
        self.counts["late"] += 1
        self._write(self._writer.tx_late(dx_ticks, reason))

    def _write(self, line: bytes) -> None:
        if not self._send(line):
            self.counts["unsent"] += 1


(_CONFIG,) = link.Reader().read(link.Writer().config(0, 0))


def _is_frame(psdu: bytes) -> bool:
    """Whether a board sends these bytes: what the line has damaged is refused."""
    return 3 <= len(psdu) <= link.MAX_FRAME_BYTES and is_intact(psdu)


class ListenerProtocol:
    """The JSON lines of the uwb-apps listener."""

    def __init__(self, send: Send) -> None:
        self._send = send

    def on_radio_event(self, event: RadioEvent) -> None:
        """One line for each frame."""
        if not isinstance(event, Reception):
            return
        measured, frame = event.diagnostics or Diagnostics(), event.frame
        power_dbm = -90.0 if measured.rx_power_dbm is None else measured.rx_power_dbm
        line = {
            "utime": round((event.host_s or 0.0) * 1e6),
            "ts": event.rx_ticks,
            "rssi": round(power_dbm, 1),
            "dlen": len(frame),
            "d": frame.hex(),
        }
        self._send(json.dumps(line, separators=(",", ":")).encode() + b"\r\n")

    def on_host_data(self, data: bytes) -> None:
        """It takes no commands."""


class SnifferProtocol:
    """A Bitcraze sniffer: beacons translated into packets of a TDoA3 system, as text until the host sends ``b``."""

    def __init__(self, send: Send, *, knows_binary: bool) -> None:
        self._send, self._knows_binary = send, knows_binary
        self._binary = False
        self._almanac = AlmanacAssembly()
        self.drops: Counter[str] = Counter()

    def on_radio_event(self, event: RadioEvent) -> None:
        """One packet for each beacon."""
        if not isinstance(event, Reception):
            return
        beacon = decode_cached(event.frame)
        if not isinstance(beacon, Beacon) or beacon.anchor > _LAST_ID:
            self.drops["not-translated"] += 1
            return
        self._almanac.add_page(beacon.almanac_issue, beacon.page)
        payload = self._payload(beacon)
        if self._binary:
            length = struct.pack("<H", len(payload))
            stamp = event.rx_ticks.to_bytes(5, "little")
            self._send(b"\xbc" + stamp + bytes((beacon.anchor, 0xFF)) + length + payload + length)
        else:
            self._send(b"From %02x to ff @%010x: %s\r\n" % (beacon.anchor, event.rx_ticks, payload.hex().encode()))

    def on_host_data(self, data: bytes) -> None:
        """``b`` asks for binary."""
        self._binary = self._binary or (self._knows_binary and b"b" in data)

    def _payload(self, beacon: Beacon) -> bytes:
        """Type, sequence, TX time, when the anchor heard which other, and the times of flight that are known."""
        heard = [
            entry for entry in (beacon.master_heard, *beacon.heard) if entry is not None and entry.anchor <= _LAST_ID
        ]
        payload = struct.pack("<BBIB", TDOA3, beacon.sequence & 0x7F, beacon.tx_ticks & 0xFFFFFFFF, len(heard))
        for entry in heard:
            tof_ticks = self._tof_ticks(beacon.anchor, entry.anchor)
            flags = (entry.sequence & 0x7F) | (0x80 if tof_ticks else 0)
            payload += struct.pack("<BBI", entry.anchor, flags, entry.rx_ticks & 0xFFFFFFFF)
            payload += struct.pack("<H", tof_ticks) if tof_ticks else b""
        return payload

    def _tof_ticks(self, one: int, other: int) -> int:
        positions_m = self._almanac.anchors_m
        if one not in positions_m or other not in positions_m:
            return 0
        squared_m2: float = sum((a - b) ** 2 for a, b in zip(positions_m[one], positions_m[other], strict=True))
        return min(round(math.sqrt(squared_m2) / SPEED_OF_LIGHT_MPS * TICK_RATE_HZ), 0xFFFF)


class Board:
    """A board from its radio to its serial port."""

    def __init__(
        self, radio: Radio, kind: Literal["anchor", "tag"], board_format: BoardFormat, link: Path | None, log: Log
    ) -> None:
        """Open the pseudo-terminal. Raises SkylessError."""
        self.radio, self._log = radio, log
        self.pty = Pty(link)
        self.protocol: BoardProtocol
        if board_format == "link":
            self.protocol = LinkProtocol(radio, self.pty.send, can_transmit=kind == "anchor")
        elif board_format == "listener":
            self.protocol = ListenerProtocol(self.pty.send)
        elif board_format in ("uci", "uci-2"):
            self.protocol = UciProtocol(self.pty.send, 1 if board_format == "uci" else 2)
        else:
            self.protocol = SnifferProtocol(self.pty.send, knows_binary=board_format == "sniffer")

    async def run(self) -> None:
        """Serve until cancelled."""
        self.pty.start(self.protocol.on_host_data)
        try:
            await self.radio.run(self._on_event)
        finally:
            self.pty.close()

    def _on_event(self, event: RadioEvent) -> None:
        if isinstance(event, Restarted):
            self._log(f"board {self.radio.name}: on the air")
        elif isinstance(event, Gone):
            self._log(f"board {self.radio.name}: {event.reason}; still looking for it")
        elif isinstance(event, Hint):
            self._log(f"board {self.radio.name}: {event.text}")
        self.protocol.on_radio_event(event)
