"""The ether: the emulated air of a site as a server, in real time, for anchors and tags in other processes."""

import asyncio
import time
from collections.abc import Callable
from typing import Final

import msgspec

from skyless.air.codec import MAX_FRAME_BYTES
from skyless.air.reception import Transmission
from skyless.constants import TICK_S
from skyless.mqtt.messages import EtherHealth, TrueMotion, TruthMessage, Vector
from skyless.nodes.emulation.ether_clients import Client, Session
from skyless.radios.emulated.ether_wire import (
    Arrival,
    Clocks,
    Done,
    HeardRow,
    Join,
    Joined,
    Send,
    WireError,
    this_machine,
)
from skyless.simulation.impairments import Impairments
from skyless.simulation.medium import Delivery, Medium
from skyless.simulation.stations import TagSpec
from skyless.simulation.trajectory import Trajectory
from skyless.site.model import Site
from skyless.ticks import wrap

STALL_S: Final = 0.1
"""An ether that falls behind by so much (a process that was stopped) lets true time stand still meanwhile."""

CLOCKS_S: Final = 0.1


class Ether:
    """One site's air and who is on it. ``clock`` gives the host's monotonic time in s."""

    def __init__(
        self,
        site: Site,
        tags: dict[str, Trajectory],
        impairments: Impairments,
        seed: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.site, self._tags, self._clock = site, tags, clock
        specs = [TagSpec(trajectory) for trajectory in tags.values()]
        faults = msgspec.structs.replace(impairments, diagnostics=True)
        self.medium: Medium[None] = Medium(site, specs, faults, seed, self._deliver)
        self._nodes = {("anchor", str(anchor)): node for anchor, node in self.medium.node_of.items()}
        self._nodes |= {("tag", name): len(site.anchors) + index for index, name in enumerate(tags)}
        self._owners: dict[int, Session] = {}
        self._flying: dict[int, int] = {}
        self._origin_s = clock()
        self._timer: asyncio.TimerHandle | None = None
        self.stalls = self.overruns = 0

    async def serve(self, host: str, port: int) -> asyncio.Server:
        """Listen; port 0 takes any free one.

        Raises:
            OSError: the address cannot be listened to.
        """
        loop = asyncio.get_running_loop()
        self._origin_s = self._clock()
        return await loop.create_server(lambda: Client(self), host, port)

    # Time

    def advance(self) -> None:
        """Let true time catch up with the host's, and wake again at the next event."""
        behind_s = self._clock() - self._origin_s - self.medium.now_s
        if behind_s > STALL_S:
            self._origin_s += behind_s
            self.stalls += 1
        for _ in self.medium.run(self._clock() - self._origin_s):
            pass
        self._arm()

    def _arm(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        ticks = self.medium.timeline.next_ticks
        due_s = CLOCKS_S / 2.0 if ticks is None else self._origin_s + ticks * TICK_S - self._clock()
        loop = asyncio.get_running_loop()
        self._timer = loop.call_later(min(max(due_s, 0.0), CLOCKS_S / 2.0), self.advance)

    async def tell_clocks(self) -> None:
        """Tell every process its nodes' counters, for ever."""
        while True:
            await asyncio.sleep(CLOCKS_S)
            self.advance()
            for seat in set(self._owners.values()):
                seat.tell(Clocks(self.now_host_s, self._counters(seat)))

    @property
    def now_host_s(self) -> float:
        """The host's monotonic time of the medium's present."""
        return self._origin_s + self.medium.now_s

    def _counters(self, seat: Session) -> tuple[int, ...]:
        return tuple(wrap(self.medium.read_counter(node)) for node in seat.nodes)

    # Guests

    def join(self, guest: Client, message: Join) -> Session | str:
        """Put a process's nodes on the air; or why not."""
        nodes = [self._nodes.get((message.kind, name)) for name in message.names]
        for name, node in zip(message.names, nodes, strict=True):
            if node is None:
                known = ", ".join(name for kind, name in self._nodes if kind == message.kind)
                return f"the ether's site has no {message.kind} {name}; it has: {known}"
            if node in self._owners or nodes.count(node) > 1:
                return f"{message.kind} {name} is on the air already"
        self.advance()
        seat = Session(guest, tuple(node for node in nodes if node is not None))
        for node in seat.nodes:
            self._owners[node] = seat
            self.medium.switch_on(node)
        seat.tell(Joined(this_machine(), self.now_host_s, self._counters(seat)))
        return seat

    def leave(self, seat: Session) -> None:
        """Take a process's nodes off the air."""
        for node in seat.nodes:
            self._owners.pop(node, None)
            self._flying.pop(node, None)
            self.medium.switch_off(node)

    def send(self, seat: Session, message: Send) -> None:
        """Plan a transmission, unless it is too late or the node's radio has one waiting already.

        Raises:
            WireError: no radio of an anchor sends that.
        """
        node = seat.nodes[message.node]
        if node >= len(self.site.anchors) or len(message.frame) > MAX_FRAME_BYTES:
            raise WireError("a transmission by a tag, or of a frame that is too long")
        self.advance()
        taken = node not in self._flying and self.medium.transmit(node, Transmission(message.frame, message.tx_ticks))
        if taken:
            self._flying[node] = message.tx_ticks
            self._arm()
        else:
            seat.tell(Done(message.node, message.tx_ticks, late=True))

    def _deliver(self, delivery: Delivery) -> None:
        """Give a frame that has ended to all processes that have nodes that heard it, and tell its sender."""
        flight, host_s = delivery.flight, self.now_host_s
        rows: dict[Session, list[HeardRow]] = {}
        for heard in (delivery.by_anchors, delivery.by_tags):
            columns = ("node", "rx_ticks", "rx_power_dbm", "first_path_power_dbm", "carrier_offset_ppm")
            for node, *values in zip(*(heard[column].tolist() for column in columns), strict=True):
                seat = self._owners.get(node)
                if seat is not None:
                    rows.setdefault(seat, []).append(HeardRow(seat.index[node], *values))
        for seat, heard_rows in rows.items():
            if not seat.tell(Arrival(flight.frame, host_s, tuple(heard_rows))):
                self.overruns += len(heard_rows)
        if flight.boot != self.medium.boots[flight.sender]:
            return  # the process that sent it has gone meanwhile
        sender = self._owners.get(flight.sender)
        tx_ticks = self._flying.pop(flight.sender, None)
        if sender is not None and tx_ticks is not None:
            sender.tell(Done(sender.index[flight.sender], tx_ticks, late=False))

    # What is known of it all

    def truth(self, unix_less_host_s: float) -> TruthMessage:
        """Where the tags that are on the air truly are now; ``unix_less_host_s``: unix time less the host's."""
        now_s, unix_s = self.medium.now_s, self.now_host_s + unix_less_host_s
        motions = {}
        for name, trajectory in self._tags.items():
            if self._nodes["tag", name] in self._owners:
                place, velocity = trajectory.position(now_s), trajectory.velocity(now_s)
                motions[name] = TrueMotion(_vector(place), _vector(velocity))
        return TruthMessage(unix_s, motions)

    def health(self, unix_s: float) -> EtherHealth:
        """What the air has carried so far."""
        tally = self.medium.tally
        return EtherHealth(
            unix_s,
            self.medium.now_s,
            tally.transmissions,
            tally.late_transmissions,
            tally.at_anchors,
            tally.at_tags,
            self.stalls,
            self.overruns,
        )


def _vector(values: object) -> Vector:
    x, y, z = values.tolist()  # type: ignore[attr-defined]
    return x, y, z
