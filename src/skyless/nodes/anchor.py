"""One anchor as a program: its protocol machine on a radio, its health on MQTT."""

import asyncio
import time
from collections import Counter
from collections.abc import Callable
from typing import Final

from skyless.air.beacon import Beacon
from skyless.air.codec import decode_cached
from skyless.air.reception import Reception
from skyless.anchor import Anchor
from skyless.constants import TICK_RATE_HZ
from skyless.nodes.hearing import Hearing
from skyless.radios.interface import Gone, Hint, Late, Radio, RadioEvent, Restarted, Sent
from skyless.site.model import Site
from skyless.ticks import difference

LEAD_S: Final = 1.8e-3
"""How long before its RMARKER a frame is handed to the radio: its preamble, the way there, and a host's timers."""

MAX_LEAD_S: Final = 8e-3
LEAD_GAIN: Final = 1.25
LEAD_LOSS: Final = 0.998
"""A host that is late hands its frames over earlier: by the gain with each late one, up to the maximum, and back by the
loss with each one sent. What an earlier frame costs is relayed stamps that are older by as much."""

ASK_AGAIN_S: Final = 5e-3
LOST_ANSWER_S: Final = 0.25
"""A radio that has not said for so long what became of a frame will not say it any more."""

_NOT_DROPS: Final = frozenset({"heard", "sent", "takeover"})


class AnchorNode:
    """Runs ``Anchor`` on a radio. ``said`` is told in words what a person should know."""

    def __init__(self, site: Site, anchor_id: int, radio: Radio, said: Callable[[str], None]) -> None:
        self.site, self.id, self.radio = site, anchor_id, radio
        self.machine = self._new_machine()
        self.started_s = time.monotonic()
        self.late = 0
        self.lead_s = LEAD_S
        """How long before its RMARKER the next frame is made."""
        self.restarts = 0
        self.heard_s: dict[int, float] = {}
        """When each other anchor was last heard, by the host's monotonic clock."""
        self._said = said
        self._came = 0
        self._hearing = Hearing(f"anchor {self.id}", said, radio.advice)
        self._timer: asyncio.TimerHandle | None = None

    def _new_machine(self) -> Anchor:
        return Anchor(self.site, self.id, lead_s=LEAD_S)

    async def run(self) -> None:
        """Serve until cancelled."""
        try:
            await self.radio.run(self.hear)
        finally:
            if self._timer is not None:
                self._timer.cancel()

    def hear(self, event: RadioEvent) -> None:
        """Take what the radio tells."""
        if isinstance(event, Reception):
            self._came += 1
            self.machine.hear(event)
            self._note(event)
        elif isinstance(event, Sent):
            self.lead_s = max(self.lead_s * LEAD_LOSS, LEAD_S)
            self._plan()
        elif isinstance(event, Late):
            self.late += 1
            self.lead_s = min(self.lead_s * LEAD_GAIN, MAX_LEAD_S)
            self._wait(ASK_AGAIN_S, self._plan)
        elif isinstance(event, Restarted):
            self.restarts += 1
            self._hearing.begin()
            self._said(f"anchor {self.id}: on the air" + (" again" if self.restarts > 1 else ""))
            self.machine = self._new_machine()
            self._plan()
        elif isinstance(event, Gone):
            self._hearing.end()
            self._said(f"anchor {self.id}: {event.reason}; still looking for it")
            self._wait(None, self._plan)
        elif isinstance(event, Hint):
            self._said(f"anchor {self.id}: {event.text}")

    def look(self, now_s: float) -> None:
        """Log where to look if it hears nothing of use; ``now_s`` is the host's monotonic clock."""
        counters = self.machine.counters
        drops = Counter({reason: count for reason, count in counters.items() if reason not in _NOT_DROPS})
        self._hearing.look(now_s, self._came, counters["heard"], drops + self.radio.counters)

    def _note(self, reception: Reception) -> None:
        beacon = decode_cached(reception.frame)
        if isinstance(beacon, Beacon) and beacon.site == self.site.id:
            self.heard_s[beacon.anchor] = time.monotonic()

    def _wait(self, seconds: float | None, then: Callable[[], None]) -> None:
        """Do one thing later, and nothing else that was planned; None plans nothing."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None if seconds is None else asyncio.get_running_loop().call_later(seconds, then)

    def _plan(self) -> None:
        """Ask the machine when to speak next."""
        now_ticks = self.radio.now_ticks()
        tx_ticks = None if now_ticks is None else self.machine.next_transmission_ticks(now_ticks)
        if now_ticks is None or tx_ticks is None:
            self._wait(ASK_AGAIN_S, self._plan)
            return
        ahead_s = difference(tx_ticks, now_ticks) / TICK_RATE_HZ - self.lead_s
        self._wait(max(ahead_s, 0.0), lambda: self._speak(tx_ticks))

    def _speak(self, tx_ticks: int) -> None:
        """Hand the frame to the radio, and ask again should it never answer."""
        self._wait(LOST_ANSWER_S, self._plan)
        self.radio.transmit(self.machine.transmission(tx_ticks))
