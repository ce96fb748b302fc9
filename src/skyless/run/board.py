"""``skyless board``: an emulated board, one node of the emulated air behind a pseudo-terminal."""

import asyncio
import json
import math
import struct
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final, Literal

from msgspec.structs import replace

from skyless.core.air.frame import Diagnostics, Malformed, Reception, Transmission, is_intact
from skyless.core.any_receiver import SiteBeacon, decode_any
from skyless.core.fix import Fix
from skyless.core.integrity import IntegrityRequirement
from skyless.core.protocol1.almanac import AlmanacAssembly
from skyless.core.protocol1.beacon import Beacon
from skyless.core.tag.receiver import NOT_DROPS, Receiver
from skyless.core.ticks import TICK_M, difference, wrap
from skyless.radio.foreign.bitcraze import TDOA3
from skyless.radio.foreign.uci import (
    NO_LOCATION,
    RELATIVE_LOCATION,
    DtMeasurement,
    DtMessageType,
    SessionInfo,
    encode_packet,
    encode_relative,
    encode_session_info,
)
from skyless.radio.interface import Gone, Hint, Late, Radio, RadioEvent, Restarted, Sent
from skyless.radio.serial import link
from skyless.radio.serial.link import ANY_SITE, MODES, OUTPUTS, BoardSettings, pack, to_steps, unpack
from skyless.radio.serial.serial_port import Pty
from skyless.radio.tag_reports import BODY_AT, fix_body, georeference_body, place_body, status_body
from skyless.run.fix_log import Lateness
from skyless.run.open_radio import RadioMonitor
from skyless.run.process import HEALTH_S, Log, RateLimit, every, together
from skyless.sim.dw1000.chip import Sensors

# A board that is a tag by itself. Like the firmware (``firmware/source/tag.c``), it computes with ``Receiver``, but it
# uses this computer's clock, and neither sleeps nor advertises.

_REPEAT_S: Final = 10.0
"""Interval at which anchor positions and the georeference are repeated."""


class BoardTag:
    """The tag on a board. ``settings`` are in use; ``flash`` holds those used after a restart."""

    def __init__(self, report: Callable[[int, bytes], None], clock_s: Callable[[], float] = time.monotonic) -> None:
        """``report(kind, body)`` sends a record; ``clock_s()`` is the host's time, on the clock of the receptions."""
        self._report, self._clock_s = report, clock_s
        self.flash = BoardSettings()
        self.begin(self.flash)

    def begin(self, settings: BoardSettings) -> None:
        """Start again with these settings."""
        self._receiver = Receiver(
            site=None if settings.site == ANY_SITE else settings.site,
            qa=settings.qa_m2ps3,
            z_bounds_m=(settings.low_mm / 1000, settings.high_mm / 1000) if settings.has_bounds else None,
            integrity=IntegrityRequirement(settings.integrity_risk, settings.alert_limit_m or None),
        )
        self.settings = settings
        self._rate, self._lateness = RateLimit(settings.rate_hz or 1e6), Lateness()
        self._begun_s = self._clock_s()
        self._fixed_s = self._placed_s = -_REPEAT_S
        self._placed: tuple[int, ...] = ()
        """Anchors whose positions were sent last."""

    @property
    def is_on(self) -> bool:
        """Whether the board computes its position; otherwise it is only a radio for its host."""
        return MODES[self.settings.mode] == "tag"

    def execute(self, record: bytes) -> None:
        """Execute a command about the settings or the time; the time is ignored, as it is known here."""
        if record[0] == link.SET_TAG_CONFIG:
            settings = unpack(record[link.SETTINGS_AT :])
            if settings is None or OUTPUTS[settings.output] != "records":
                self._report(link.REFUSED, bytes((link.SET_TAG_CONFIG, link.REFUSED_SETTING)))
                return
            self.begin(settings)
            if record[BODY_AT] & link.IN_FLASH:
                self.flash = settings
        if record[0] != link.SET_TIME:
            self._report(link.TAG_CONFIG, bytes((link.IN_FLASH * (self.flash == self.settings),)) + pack(self.settings))

    def hear(self, reception: Reception) -> None:
        """Process a frame, and report the position if due."""
        now_s = self._clock_s()
        ended_s = now_s if reception.host_s is None else reception.host_s
        if not self._lateness.admits(ended_s, now_s) or (fix := self._receiver.hear(reception)) is None:
            return
        self._fixed_s = now_s
        if self._rate.is_due(ended_s):
            if fix.anchors != self._placed or now_s - self._placed_s > _REPEAT_S:
                self._say_places(fix, now_s)
            latency_s, serial = self._clock_s() - ended_s, self._receiver.counters["fixes"]
            who = self._receiver.site or 0, self.settings.tag
            self._report(link.FIX, fix_body(fix, time.time() - latency_s, reception.rx_ticks, latency_s, serial, *who))

    def _say_places(self, fix: Fix, now_s: float) -> None:
        self._placed, self._placed_s, heard = fix.anchors, now_s, self._receiver.heard_site
        for anchor, place_m in zip(fix.anchors, fix.anchors_m.tolist(), strict=True):
            self._report(link.ANCHOR_PLACE, place_body(anchor, place_m))
        if heard is not None and heard.georeference is not None:
            self._report(link.GEOREFERENCE, georeference_body(heard.georeference))

    def each_second(self) -> None:
        """Report the counters, and the reason if there is no fix."""
        if self.is_on:
            receiver, counted, now_s = self._receiver, self._receiver.counters, self._clock_s()
            reason = receiver.reason if now_s - self._fixed_s > HEALTH_S else None
            dropped = sum(count for why, count in counted.items() if why not in NOT_DROPS)
            counts = counted["heard"], counted["fixes"], self._lateness.dropped, 0, dropped
            self._report(link.TAG_STATUS, status_body(receiver.site, reason, counts, now_s - self._begun_s))


Send = Callable[[bytes], bool]
_EMULATED_FIRMWARE: Final = (0, 0, 0)
_LAST_ID: Final = 0xFF
_SESSION: Final = 1
_MAX_FLIGHT_TICKS: Final = 0xFFFF
_MAX_REPLY_TICKS: Final = 0xFFFF_FFFF
_MAX_MEASUREMENTS: Final = 0xFF
_RELATIVE_2: Final = bytes((1, 1 | 1 << 1))
"""Prefix of a relative location in version 2."""

BoardFormat = Literal["link", "sniffer", "sniffer-text", "listener", "uci", "uci-2"]
RADIO_OF: Final[dict[BoardFormat, str]] = {
    "link": "serial",
    "sniffer": "sniffer",
    "sniffer-text": "sniffer",
    "listener": "listener",
    "uci": "uci",
    "uci-2": "uci",
}
"""Type of radio in ``--radio`` for a board of each format."""


class BoardProtocol:
    """The protocol of a board's serial line."""

    def on_radio_event(self, event: RadioEvent) -> None:
        """Report an event of the radio to the host."""
        raise NotImplementedError

    def on_host_data(self, data: bytes) -> None:
        """Process bytes from the host; most boards take no commands."""


class LinkProtocol(BoardProtocol):
    """The serial link, as the firmware of real boards speaks it (``firmware/source/board.c``)."""

    def __init__(
        self, radio: Radio, send: Send, *, can_transmit: bool, clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        """``clock_s()`` is its host's time."""
        self._radio, self._send, self._can_transmit = radio, send, can_transmit
        self._clock_s = clock_s
        self.tag = BoardTag(self.report, clock_s)
        self._tested = 0
        self._reader, self._writer = link.Reader(), link.Writer()
        self._configured = self._receiving = self._wants_phases = False
        self._tx_delay_ticks = 0
        self._waiting: dict[int, int] = {}
        """``dx`` of frames not sent yet, by TX stamp."""
        self.counts = dict.fromkeys(("received", "errors", "sent", "late", "garbled", "unsent"), 0)

    def on_radio_event(self, event: RadioEvent) -> None:
        """Send the records of an event, if the host has asked for them."""
        if isinstance(event, Reception):
            self._hear(event)
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
            self.tag.begin(self.tag.flash)
            self._hello()

    def _hear(self, reception: Reception) -> None:
        if self.tag.is_on:
            self.tag.hear(reception)
            return
        if not self._receiving:
            return
        self.counts["received"] += 1
        measured = to_steps(reception.diagnostics or Diagnostics())
        phase_cycles = reception.carrier_phase_cycles if self._wants_phases else None
        phase = None if phase_cycles is None else link.to_turn(phase_cycles)
        self._write(self._writer.rx(reception.rx_ticks, *measured, reception.frame, phase))

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
            self._transmit(int.from_bytes(record[BODY_AT : link.TX_FRAME_AT], "little"), record[link.TX_FRAME_AT :])
        elif kind in (link.RX_ON, link.TX_AT):
            self.report(link.REFUSED, bytes((kind, link.REFUSED_MALFORMED)))
        elif kind in (link.SET_TAG_CONFIG, link.ASK_TAG_CONFIG, link.SET_TIME):
            self.tag.execute(record)
        elif kind == link.READ and len(record) >= link.READ_DATA_AT:
            self._read(record)
        elif kind == link.TEST_LINE and len(record) >= BODY_AT + 3:
            self._tested += 1
            self._send_tests(int.from_bytes(record[2:4], "little"), record[4])
        else:
            self.counts["garbled"] += 1

    def _hello(self) -> None:
        name = self._radio.name.encode()[:8].ljust(8, b"\0")
        abilities = link.HAS_PHASES | (link.CAN_TRANSMIT if self._can_transmit else link.CAN_COMPUTE)
        self._write(self._writer.hello(_EMULATED_FIRMWARE, name, abilities))

    def _status(self) -> None:
        ticks = self._radio.now_ticks()
        state = self._configured * link.IS_CONFIGURED | self._receiving * link.IS_RECEIVING
        state |= bool(self._waiting) * link.HAS_FRAME_WAITING
        counts = self.counts | {"garbled": self.counts["garbled"] + self._reader.garbled + self._reader.overlong}
        self._write(self._writer.status(ticks or 0, state, list(counts.values())))

    def _configure(self, record: bytes) -> None:
        """Set the antenna delays; the other settings must match the air."""
        if len(record) < link.CONFIG_BYTES or record[2:8] != _CONFIG[2:8]:
            reason = link.REFUSED_MALFORMED if len(record) < link.CONFIG_BYTES else link.REFUSED_SETTING
            self.report(link.REFUSED, bytes((link.CONFIG, reason)))
            return
        self._tx_delay_ticks = int.from_bytes(record[8:10], "little")
        self._wants_phases = bool(record[link.CONFIG_BYTES - 1] & link.WANTS_PHASES)
        self._configured, self._receiving = True, False
        self.tag.settings = replace(self.tag.settings, mode=MODES.index("radio"))
        self._status()

    def _send_tests(self, count: int, line_bytes: int) -> None:
        """Send as many records as are asked for, as fast as the line would carry them."""
        if count:
            self.report(link.TEST, bytes(range(max(line_bytes - link.TEST_OVERHEAD, 0))))
            pause_s = 10 * line_bytes / self.tag.settings.baud
            asyncio.get_running_loop().call_later(pause_s, self._send_tests, count - 1, line_bytes)

    def _read(self, record: bytes) -> None:
        """Answer READ as a board without a fault would: there is no chip here."""
        file, sub, octets = record[2], int.from_bytes(record[3:5], "little"), record[5]
        now_s, ticks = self._clock_s(), self._radio.now_ticks() or 0
        us, periods = round(1e6 * now_s) & 0xFFFF_FFFF, round(32_768 * now_s) & 0xFF_FFFF
        found = {
            0x00: link.DEVICE_ID.to_bytes(4, "little"),
            link.OTP: Sensors().otp().get(sub, 0).to_bytes(4, "little"),
            link.FACTS: struct.pack("<7I", 0x52832, 0, 5 << 4, 21, 0xFFFF_FFFF, 12_288, 6_000),
            link.CLOCKS: struct.pack("<2I", us, periods) + ticks.to_bytes(5, "little"),
            link.COUNTS: struct.pack("<5I", 100, 0, 0, 275, self._tested),
        }.get(file, record[link.READ_DATA_AT :] or bytes(octets))
        self.report(link.VALUE, record[2:5] + bytes(2) + found)

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

    def report(self, kind: int, body: bytes) -> None:
        """Send a record of any kind."""
        self._write(self._writer.record(kind, body))

    def _write(self, line: bytes) -> None:
        if not self._send(line):
            self.counts["unsent"] += 1


(_CONFIG,) = link.Reader().read(link.Writer().config(0, 0))


def _is_frame(psdu: bytes) -> bool:
    """Whether a board would send these bytes; frames damaged on the line are refused."""
    return 3 <= len(psdu) <= link.MAX_FRAME_BYTES and is_intact(psdu)


class ListenerProtocol(BoardProtocol):
    """The JSON lines of the uwb-apps listener."""

    def __init__(self, send: Send) -> None:
        self._send = send

    def on_radio_event(self, event: RadioEvent) -> None:
        """Write one line for each frame."""
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


class _BeaconTranslator(BoardProtocol):
    """Base of emulated boards of other systems, which report beacons as messages of their own systems."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self._almanac = AlmanacAssembly()
        self._anchors_m: dict[int, tuple[float, float, float]] = {}
        """Positions that anchors of protocol 2 have stated."""
        self.drops: Counter[str] = Counter()

    def _beacon(self, event: RadioEvent, greatest_anchor: int = 0xFFFF) -> SiteBeacon | None:
        """Decode the beacon of a reception; None for other events and for frames that cannot be translated."""
        if not isinstance(event, Reception):
            return None
        beacon = decode_any(event.frame)
        if isinstance(beacon, Malformed) or beacon.anchor > greatest_anchor:
            self.drops["not-translated"] += 1
            return None
        if isinstance(beacon, Beacon):
            self._almanac.add_page(beacon.almanac_issue, beacon.page)
        elif (stated := beacon.position) is not None:
            self._anchors_m[beacon.anchor] = (stated.x_m, stated.y_m, stated.z_m)
        return beacon

    def _position_m(self, anchor: int) -> tuple[float, float, float] | None:
        return self._anchors_m.get(anchor) or self._almanac.anchors_m.get(anchor)

    def _flight_ticks(self, one: int, other: int) -> int:
        """Time of flight between two anchors, as if they had ranged; 0 if it is unknown or exceeds the field."""
        one_m, other_m = self._position_m(one), self._position_m(other)
        if one_m is None or other_m is None:
            return 0
        ticks = round(math.dist(one_m, other_m) / TICK_M)
        return ticks if ticks <= _MAX_FLIGHT_TICKS else 0


class SnifferProtocol(_BeaconTranslator):
    """A Bitcraze sniffer: reports beacons as packets of a TDoA3 system, in text until the host sends ``b``."""

    def __init__(self, send: Send, *, knows_binary: bool) -> None:
        super().__init__(send)
        self._knows_binary, self._binary = knows_binary, False

    def on_radio_event(self, event: RadioEvent) -> None:
        """Send one packet for each beacon."""
        beacon = self._beacon(event, _LAST_ID)
        if beacon is None or not isinstance(event, Reception):
            return
        payload = self._payload(beacon)
        if self._binary:
            length = struct.pack("<H", len(payload))
            stamp = event.rx_ticks.to_bytes(5, "little")
            self._send(b"\xbc" + stamp + bytes((beacon.anchor, 0xFF)) + length + payload + length)
        else:
            self._send(b"From %02x to ff @%010x: %s\r\n" % (beacon.anchor, event.rx_ticks, payload.hex().encode()))

    def on_host_data(self, data: bytes) -> None:
        """Switch to binary on ``b``."""
        self._binary = self._binary or (self._knows_binary and b"b" in data)

    def _payload(self, beacon: SiteBeacon) -> bytes:
        """Payload of a packet: type, sequence, TX time, other anchors' times of reception, and times of flight."""
        heard = [entry for entry in beacon.relayed if entry.anchor <= _LAST_ID]
        payload = struct.pack("<BBIB", TDOA3, beacon.sequence & 0x7F, beacon.tx_ticks & 0xFFFFFFFF, len(heard))
        for entry in heard:
            tof_ticks = self._flight_ticks(beacon.anchor, entry.anchor)
            flags = (entry.sequence & 0x7F) | (0x80 if tof_ticks else 0)
            payload += struct.pack("<BBI", entry.anchor, flags, entry.rx_ticks & 0xFFFFFFFF)
            payload += struct.pack("<H", tof_ticks) if tof_ticks else b""
        return payload


class UciProtocol(_BeaconTranslator):
    """A FiRa board: reports a site's beacons as the rounds of a DL-TDoA session, in UCI notifications.

    Only a site with a master has rounds, one per superframe. The master's beacon is the poll, and the other anchors'
    are the responses, each stating when its sender received the master's. If anchors have two frames in a superframe,
    the master's second one is the final message, stating when it received the responses; later frames belong to no
    round.

    A round is sent as soon as it has all messages that the previous round had, or with the next poll. Messages that
    come later are sent in notifications of their own.
    """

    def __init__(self, send: Send, version: Literal[1, 2]) -> None:
        super().__init__(send)
        self._version = version
        self._heard: set[tuple[int, DtMessageType]] = set()
        """Messages of this round."""
        self._usual: set[tuple[int, DtMessageType]] = set()
        """Messages of the previous round."""
        self._waiting: list[tuple[Beacon, DtMeasurement]] = []
        self._poll: Beacon | None = None
        self._sequence = 0

    def on_radio_event(self, event: RadioEvent) -> None:
        """Add a beacon to its round."""
        beacon = self._beacon(event)
        if beacon is None or not isinstance(event, Reception):
            return
        if not isinstance(beacon, Beacon):
            self.drops["site-without-a-master"] += 1
            return
        poll = self._poll
        if beacon.anchor == beacon.master and (poll is None or beacon.superframe != poll.superframe):
            self._notify()
            self._usual, self._heard, self._poll = self._heard, set(), beacon
        measurement = self._measurement(beacon, event)
        if measurement is None:
            self.drops["not-of-a-round"] += 1
            return
        self._heard.add((beacon.anchor, DtMessageType(measurement.message)))
        if measurement.message == DtMessageType.FINAL:
            self._waiting = [(sent, _answered(one, sent, beacon)) for sent, one in self._waiting]
        self._waiting.append((beacon, measurement))
        if self._usual <= self._heard or len(self._waiting) >= _MAX_MEASUREMENTS:
            self._notify()

    def _measurement(self, beacon: Beacon, reception: Reception) -> DtMeasurement | None:
        """Return the measurement to report for a beacon; None if the beacon does not belong to this round."""
        poll, heard = self._poll, beacon.master_heard
        if poll is None or (poll.anchor, DtMessageType.FINAL) in self._heard:
            return None
        reply = flight = 0
        if beacon is poll:
            kind = DtMessageType.POLL
        elif beacon.anchor == poll.anchor:
            kind = DtMessageType.FINAL
        else:
            kind = DtMessageType.RESPONSE
            if heard is None or (heard.anchor, heard.sequence) != (poll.anchor, poll.sequence):
                return None
            reply = difference(beacon.tx_ticks, heard.rx_ticks)
            if not 0 < reply <= _MAX_REPLY_TICKS:
                return None
            flight = self._flight_ticks(poll.anchor, beacon.anchor)
        location = self._location(beacon.anchor)
        return DtMeasurement(
            address=beacon.anchor,
            message=kind,
            block=poll.superframe & 0xFFFF,
            round=0,
            tx_ticks=beacon.tx_ticks,
            rx_ticks_tag=reception.rx_ticks,
            responder_reply_ticks=reply,
            flight_ticks=flight,
            location_kind=RELATIVE_LOCATION if location and self._version == 1 else NO_LOCATION,
            location=location,
        )

    def _location(self, anchor: int) -> bytes:
        position_m = self._almanac.anchors_m.get(anchor)
        if position_m is None:
            return b""
        try:
            location = encode_relative(position_m)
        except ValueError:
            self.drops["location-too-far"] += 1
            return b""
        return location if self._version == 1 else _RELATIVE_2 + location

    def _notify(self) -> None:
        if not self._waiting:
            return
        info = SessionInfo(self._sequence, _SESSION, self._version, tuple(one for _, one in self._waiting))
        self._waiting.clear()
        self._sequence = (self._sequence + 1) & 0xFFFF_FFFF
        self._send(encode_packet(encode_session_info(info)))


def _answered(one: DtMeasurement, sent: Beacon, final: Beacon) -> DtMeasurement:
    """Add to a response the initiator's reply time, from the final message; unchanged if it was not received."""
    heard = next((entry for entry in final.heard if entry.anchor == one.address), None)
    if one.message != DtMessageType.RESPONSE or heard is None or heard.sequence != sent.sequence:
        return one
    reply = difference(final.tx_ticks, heard.rx_ticks)
    return replace(one, initiator_reply_ticks=reply) if 0 < reply <= _MAX_REPLY_TICKS else one


class Board:
    """An emulated board, from its radio to its serial port."""

    def __init__(
        self, radio: Radio, kind: Literal["anchor", "tag"], board_format: BoardFormat, link: Path | None, log: Log
    ) -> None:
        """Open the pseudo-terminal. Raises SkylessError."""
        self.radio = radio
        self.pty = Pty(link)
        self._monitor = RadioMonitor(f"board {radio.name}", "on the air", log, radio.advice)
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
            protocol = self.protocol
            seconds = (every(HEALTH_S, protocol.tag.each_second),) if isinstance(protocol, LinkProtocol) else ()
            await together(self.radio.run(self._on_event), *seconds)
        finally:
            self.pty.close()

    def _on_event(self, event: RadioEvent) -> None:
        if isinstance(event, Restarted | Gone | Hint):
            self._monitor.on_event(event)
        self.protocol.on_radio_event(event)
