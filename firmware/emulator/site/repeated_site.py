"""The site of a run again with the emulated radio, without boards and chips: the reference of ``EmulatedSite``.

What a frame contains depends on what its anchor had been given when it made it, and that depends on how long receptions
are on their way. So the programs run again with the instants of the run with boards, and nothing else of it: when each
reception and each end of a frame reached them, which frames were late, and how far the board's counter was estimated
wrongly. Frames and stamps are made again by the anchors' machines and the medium of the same seed. Powers, carrier
offsets and phases are those that the boards reported, because chips round them.
"""

import asyncio
import time
from collections import Counter

from msgspec.structs import replace

from emulator.site.emulated_site import Board, EmulatedSite, SiteNode
from skyless.core.air.reception import Reception, Transmission
from skyless.core.ticks import wrap
from skyless.radio.interface import Late, Listener, Radio, RadioEvent


class DivergedError(Exception):
    """The programs did not do what they did on boards."""


class RepeatingRadio:
    """The emulated radio of one node with the instants of a board (``skyless.radio.interface.Radio``)."""

    def __init__(self, node: SiteNode, before: SiteNode) -> None:
        """``before`` is the node in the run with boards."""
        self.name, self.lead_s = node.name, before.radio.lead_s
        self.counters: Counter[str] = Counter()
        self._node = node
        self._number = {key: number for number, key in enumerate(before.at_antenna)}
        self._arrived: list[tuple[bytes, int]] = []
        self._events, self._lags = iter(before.radio.instants.events), iter(before.radio.instants.lags)
        self._late = {event.tx_ticks for _, event in before.radio.instants.events if isinstance(event, Late)}

    async def run(self, listener: Listener) -> None:
        """Report what the antenna gets, until cancelled."""
        for host_s, event in self._events:
            if host_s > time.monotonic():
                await asyncio.sleep(host_s - time.monotonic())
            listener(self._repeat(event))
        await asyncio.Future()

    def _repeat(self, event: RadioEvent) -> RadioEvent:
        """The event as it is in this run."""
        if not isinstance(event, Reception):
            return event
        number = self._number[event.frame, event.rx_ticks]
        if number >= len(self._arrived):
            self._arrived = list(self._node.at_antenna)
        if number >= len(self._arrived):
            raise DivergedError(f"{self.name}: reception {number} has not come at {time.monotonic():.6f} s")
        frame, rx_ticks = self._arrived[number]
        return replace(event, frame=frame, rx_ticks=rx_ticks)

    def advice(self) -> str:
        """Nothing: it always works."""
        return ""

    def now_ticks(self) -> int | None:
        """The node's counter, estimated as wrongly as behind the board."""
        then_s, lag = next(self._lags, (None, None))
        if then_s != time.monotonic():
            raise DivergedError(f"{self.name}: the counter is asked for at {time.monotonic():.6f} s, not {then_s}")
        return None if lag is None else wrap(self._node.air.now_ticks() - lag)

    def transmit(self, transmission: Transmission) -> None:
        """Hand a frame to the medium, unless its board was late with it."""
        is_due = transmission.tx_ticks not in self._late
        if is_due and not self._node.air.transmit(transmission.frame, transmission.tx_ticks):
            raise DivergedError(f"{self.name}: a frame is late at {time.monotonic():.6f} s")


class RepeatedSite(EmulatedSite):
    """The site of a run that has ended, again with emulated radios."""

    def __init__(self, before: EmulatedSite) -> None:
        super().__init__(before.site, before.trajectories, _no_board, seed=before.seed, room=before.room)
        self._before = {node.name: node for node in before.nodes}

    def plug_in(self, node: SiteNode) -> None:
        """There are no boards."""

    def _radio(self, node: SiteNode) -> Radio:
        return RepeatingRadio(node, self._before[node.name])


def _no_board(*_: object, **__: object) -> Board:
    raise AssertionError
