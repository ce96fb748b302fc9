"""What an anchor has received of the others, kept for those who ask for it.

No I/O and no clock: times are passed in, by any clock that does not go back.
"""

from collections import deque
from typing import Final

from skyless.mqtt.leases import Leases
from skyless.mqtt.messages import RequestMessage, Stamp, StampsMessage

STAMPS_INTERVAL_S: Final = 0.2
"""Stamps of this time go into one message."""

MOST_PENDING_STAMPS: Final = 4096
"""Stamps; where nobody collects them, the oldest are dropped and counted."""


class StampLog:
    """The stamps of one anchor, for as long as somebody asks for them."""

    def __init__(self, anchor: int, run: str) -> None:
        """``run`` names this start of the anchor's counter."""
        self._anchor, self._run = anchor, run
        self._leases = Leases()
        self._pending: deque[Stamp] = deque()
        self._missed = 0
        self._sent_s = 0.0

    @property
    def wanted(self) -> bool:
        """Whether somebody holds a lease."""
        return self._leases.are_held

    def request(self, message: RequestMessage, now_s: float) -> None:
        """Process a request; one without ``stamps`` ends the lease of its sender."""
        if message.stamps:
            self._leases.grant(message.by, message.lease_s, now_s)
        else:
            self._leases.end(message.by)

    def restart(self, run: str) -> None:
        """The anchor's counter has restarted: what was not collected before is useless."""
        self._run, self._missed = run, 0
        self._pending.clear()

    def add(self, anchor: int, tx_ticks: int, rx_ticks: int) -> None:
        """Add a reception of another anchor: its stated TX stamp and the own RX stamp, 40 bits each."""
        if not self._leases.are_held:
            return
        if len(self._pending) >= MOST_PENDING_STAMPS:
            self._pending.popleft()
            self._missed += 1
        self._pending.append(Stamp(anchor, tx_ticks, rx_ticks))

    def collect(self, now_s: float, unix_s: float) -> StampsMessage | None:
        """The next message if it is due, also one without stamps while an anchor that is asked receives nobody."""
        self._leases.expire(now_s)
        if not self._leases.are_held:
            self._pending.clear()
            self._missed = 0
            return None
        if 0.0 <= now_s - self._sent_s < STAMPS_INTERVAL_S:
            return None
        self._sent_s = now_s
        message = StampsMessage(self._anchor, self._run, unix_s, tuple(self._pending), self._missed)
        self._pending.clear()
        self._missed = 0
        return message
