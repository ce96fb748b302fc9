"""Checks of a board on a serial port: it listens as a tag, and what it receives is judged."""

import time
from collections import Counter

from skyless.core.air.frame import Malformed, Reception
from skyless.core.any_receiver import decode_any
from skyless.core.site import NoiseSite
from skyless.core.tag.receiver import TagReceiver
from skyless.radio.interface import Gone, Hint, RadioEvent
from skyless.radio.serial.link import Hello
from skyless.radio.serial.serial_radio import SerialRadio
from skyless.run.doctor.check import Check, residuals_check, sentence
from skyless.run.doctor.clocks import CounterPairs, counters_check
from skyless.run.mqtt.messages import FixMessage
from skyless.run.tag import TagNode, TagSettings


class BoardProbe:
    """Listens with one board."""

    def __init__(self, radio: SerialRadio, site: int | None) -> None:
        """``site`` is the number of the site that it is to hear; None for the first that is heard."""
        self.radio = radio
        self._troubles: dict[str, None] = {}  # without those that have been before
        self._hello: Hello | None = None
        self._heard: Counter[int] = Counter()
        self._fixes: list[FixMessage] = []
        self._pairs = CounterPairs()
        self._node = TagNode(TagSettings(site=site), radio, self._fixes.append, lambda _: None, self._note)

    async def run(self) -> None:
        """Listen until cancelled."""
        await self.radio.run(self._on_event)

    def _on_event(self, event: RadioEvent) -> None:
        self._hello = self.radio.hello or self._hello
        if isinstance(event, Gone | Hint):
            self._troubles[event.reason if isinstance(event, Gone) else event.text] = None
        self._node.on_event(event)

    def _note(self, _receiver: TagReceiver, reception: Reception, _fixes: int) -> None:
        beacon = decode_any(reception.frame)
        if not isinstance(beacon, Malformed):
            self._heard[beacon.anchor] += 1
            self._pairs.add(self.radio.name, beacon.anchor, beacon.tx_ticks, reception.rx_ticks, time.monotonic())

    def checks(self, noise: NoiseSite) -> tuple[Check, ...]:
        """What was found."""
        name, hello, troubles = f"board {self.radio.name}", self._hello, "; ".join(self._troubles)
        if hello is None:
            advice = (
                "See its cable, the path of its port, its baud rate (serial:PATH@BAUD), and whether it has firmware."
            )
            return (Check(name, "failed", sentence(troubles or "the port could not be opened yet"), advice),)
        version = ".".join(map(str, hello.firmware))
        abilities = "can send" if hello.can_transmit else "only listens"
        finding = f"Firmware {version}, version {hello.major}.{hello.minor} of the serial link; it {abilities}."
        board = Check(name, "warning" if troubles else "ok", finding, troubles)
        return board, self._reception(f"{name}, reception"), counters_check(self._pairs, noise, f"{name}, clock")

    def _reception(self, name: str) -> Check:
        if not self._heard:
            advice = "See whether anchors of the site are on the air, and the board's antenna is free."
            return Check(name, "failed", "It has received no beacon.", advice)
        drops = sum(self._node.drops.values())
        finding = f"{sum(self._heard.values())} beacons of {len(self._heard)} anchors, {drops} frames dropped"
        if not self._fixes:
            finding = f"{finding}, no fix: {self._node.reason}."
            return Check(name, "warning", finding, "Listen for longer, or elsewhere.")
        return residuals_check(name, f"{finding}, {len(self._fixes)} fixes", self._fixes)
