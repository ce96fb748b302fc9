"""``skyless ether``: a server that emulates a site's air in real time, for anchors and tags in other processes."""

import asyncio
import socket
import time
from collections.abc import Callable
from typing import Final

import msgspec

from skyless.core.air.frame import MAX_FRAME_BYTES, Transmission
from skyless.core.site import Site
from skyless.core.ticks import TICK_S, wrap
from skyless.radio import emulated as wire
from skyless.radio.interface import ignore
from skyless.run.fix_log import MAX_RECEPTION_AGE_S
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.messages import EtherHealth, TrueMotion, TruthMessage, vector
from skyless.run.mqtt.topics import health_topic, truth_topic
from skyless.run.process import HEALTH_S, Log, every, keep, link_of, most_files, together
from skyless.sim.impairments import Impairments
from skyless.sim.listening import TagSpec
from skyless.sim.medium import Delivery, Medium
from skyless.sim.trajectory import Trajectory

_CLOCKS_S: Final = 0.1
_TRUTH_S: Final = 0.05
"""Intervals at which counters are sent to each process, and the truth to MQTT."""

_SEND_BUFFER_BYTES: Final = 1 << 16
_OVERRUN_BYTES: Final = 1 << 16
"""Frames beyond this are lost if a process does not read them, as with a radio whose host is asleep."""

_OTHER_FILES: Final = 192
"""Open files besides processes' connections: the broker's, the libraries', and connections accepted in one turn."""


class Client(asyncio.Protocol):
    """The connection of one process, and its nodes that are on the air."""

    def __init__(self, ether: "Ether") -> None:
        self._ether = ether
        self.nodes: tuple[int, ...] = ()
        self.index: dict[int, int] = {}
        """Places of the nodes in ``nodes``."""
        self.wrong_ticks: tuple[int, ...] = ()
        """By how much each radio's TX antenna delay is set too large."""
        self._unpacker = wire.Unpacker()
        self._transport: asyncio.Transport | None = None
        self._is_counted = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Set up the connection, with small buffers so that no old data pile up; refuse it if there is no room."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        endpoint = transport.get_extra_info("socket")
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        refusal = self._ether.admit()
        self._is_counted = refusal is None
        if refusal is not None:
            self._refuse(refusal)

    def send(self, message: msgspec.Struct) -> bool:
        """Send a message; return False if it was dropped because too much is waiting."""
        transport = self._transport
        if transport is None or transport.is_closing() or transport.get_write_buffer_size() > _OVERRUN_BYTES:
            return False
        transport.write(wire.pack(message))
        return True

    def data_received(self, data: bytes) -> None:
        """Process messages; refuse a client that sends anything else."""
        try:
            for body in self._unpacker.feed(data):
                self._process(body)
        except (wire.WireError, msgspec.MsgspecError) as error:
            self._refuse(f"not understood: {error}")

    def _process(self, body: bytes) -> None:
        message = wire.to_ether.decode(body)
        if isinstance(message, wire.Join) and not self.nodes:
            refusal = self._ether.join(self, message)
            if refusal is not None:
                self._refuse(refusal)
        elif isinstance(message, wire.Send) and 0 <= message.node < len(self.nodes):
            self._ether.transmit(self, message)
        else:
            raise wire.WireError("a message that does not belong here")

    def _refuse(self, reason: str) -> None:
        self.send(wire.Refused(reason))
        if self._transport is not None:
            self._transport.close()

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - the reason makes no difference
        """Take the process's nodes off the air."""
        self._ether.leave(self)
        self._ether.connections -= self._is_counted


class Ether:
    """One site's air and the nodes on it. ``clock`` gives the host's monotonic time in s."""

    def __init__(
        self,
        site: Site,
        tags: dict[str, Trajectory],
        impairments: Impairments,
        seed: int,
        clock: Callable[[], float] = time.monotonic,
        most_connections: int | None = None,
    ) -> None:
        """``most_connections`` is None for as many as the system allows."""
        self.site, self._tags, self._clock = site, tags, clock
        specs = [TagSpec(trajectory) for trajectory in tags.values()]
        faults = msgspec.structs.replace(impairments, diagnostics=True)
        self.medium: Medium[None] = Medium(site, specs, faults, seed, self._deliver)
        phase = () if impairments.carrier is None else ("phase_cycles",)
        self._columns = *("node", "rx_ticks", "rx_power_dbm", "first_path_power_dbm", "carrier_offset_ppm"), *phase
        self._nodes = {("anchor", str(anchor)): node for anchor, node in self.medium.node_of.items()}
        self._nodes |= {("tag", name): len(site.anchors) + index for index, name in enumerate(tags)}
        self._owners: dict[int, Client] = {}
        self._flying: dict[int, int] = {}
        self._origin_s = clock()
        self._most_connections = most_connections
        self.connections = 0
        """Number of connected processes, including those without nodes on the air."""
        self._is_full = False
        self._log: Log = ignore
        self._timer: asyncio.TimerHandle | None = None
        self.stalls = self.overruns = 0
        self._missed = 0
        """Transmissions whose time had passed before this process handled them."""
        self._reported = 0, 0
        """Transmissions sent and missed by the last health message."""
        self.machine = wire.this_machine()

    async def serve(self, host: str, port: int, log: Log = ignore) -> asyncio.Server:
        """Listen; port 0 takes any free one. ``log`` gets a line when no more connections are accepted.

        Raises OSError: the address cannot be listened on.
        """
        loop = asyncio.get_running_loop()
        self._origin_s = self._clock()
        self._log = log
        if self._most_connections is None:
            self._most_connections = max(1, most_files() - _OTHER_FILES)
        return await loop.create_server(lambda: Client(self), host, port)

    # Time

    def advance(self) -> None:
        """Advance true time to the host's, and schedule the next wake-up.

        Frames too old for any tag are not sent, so that a slow computer causes gaps but no delay.
        """
        now_s = self._clock() - self._origin_s
        if now_s - self.medium.now_s > MAX_RECEPTION_AGE_S:
            self.stalls += 1
            self._miss(now_s)
        for _ in self.medium.run(now_s):
            pass
        self._arm()

    def _miss(self, until_s: float) -> None:
        """Drop the frames whose time has passed, and notify their senders."""
        for node in self.medium.miss(until_s):
            self._missed += 1
            owner, tx_ticks = self._owners.get(node), self._flying.pop(node, None)
            if owner is not None and tx_ticks is not None:
                owner.send(wire.Done(owner.index[node], tx_ticks, late=True))

    def _arm(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        ticks = self.medium.timeline.next_ticks
        due_s = _CLOCKS_S / 2.0 if ticks is None else self._origin_s + ticks * TICK_S - self._clock()
        self._timer = asyncio.get_running_loop().call_later(min(max(due_s, 0.0), _CLOCKS_S / 2.0), self.advance)

    async def send_clocks(self) -> None:
        """Send every process its nodes' counters, until cancelled."""
        while True:
            await asyncio.sleep(_CLOCKS_S)
            self.advance()
            for client in set(self._owners.values()):
                client.send(wire.Clocks(self.now_host_s, self._counters(client)))

    @property
    def now_host_s(self) -> float:
        """The host's monotonic time at the medium's present."""
        return self._origin_s + self.medium.now_s

    def _counters(self, client: Client) -> tuple[int, ...]:
        return tuple(wrap(self.medium.read_counter(node)) for node in client.nodes)

    # Clients

    def admit(self) -> str | None:
        """Count a new connection; return the reason if there is no room for it."""
        most = self._most_connections
        if most is None or self.connections < most:
            self.connections += 1
            self._is_full = False
            return None
        if not self._is_full:
            self._is_full = True
            self._log(f"all {most} connections are in use (limit: ulimit -n); others are refused, these go on")
        return f"all {most} connections of the ether are in use"

    def join(self, client: Client, message: wire.Join) -> str | None:
        """Put a process's nodes on the air. Returns the reason if that is not possible."""
        nodes = [self._nodes.get((message.kind, name)) for name in message.names]
        for name, node in zip(message.names, nodes, strict=True):
            if node is None:
                known = ", ".join(name for kind, name in self._nodes if kind == message.kind)
                return f"the ether's site has no {message.kind} {name}; it has: {known}"
            if node in self._owners or nodes.count(node) > 1:
                return f"{message.kind} {name} is on the air already"
        if message.tx_delays_ticks and len(message.tx_delays_ticks) != len(nodes):
            return "tx_delays_ticks should have one value a node"
        self.advance()
        client.nodes = tuple(node for node in nodes if node is not None)
        client.index = {node: index for index, node in enumerate(client.nodes)}
        anchors, delays_ticks = self.site.anchors, message.tx_delays_ticks or (None,) * len(nodes)
        client.wrong_ticks = tuple(
            delay_ticks - anchors[node].tx_antenna_delay_ticks if delay_ticks is not None and node < len(anchors) else 0
            for node, delay_ticks in zip(client.nodes, delays_ticks, strict=True)
        )
        for node in client.nodes:
            self._owners[node] = client
            self.medium.switch_on(node)
        client.send(wire.Joined(self.machine, self.now_host_s, self._counters(client)))
        return None

    def leave(self, client: Client) -> None:
        """Take a process's nodes off the air."""
        for node in client.nodes:
            self._owners.pop(node, None)
            self._flying.pop(node, None)
            self.medium.switch_off(node)

    def transmit(self, client: Client, message: wire.Send) -> None:
        """Plan a transmission, unless it is too late or the node's radio already has one waiting.

        Raises WireError: the frame is not one that an anchor's radio sends.
        """
        node = client.nodes[message.node]
        if node >= len(self.site.anchors) or len(message.frame) > MAX_FRAME_BYTES:
            raise wire.WireError("a transmission by a tag, or of a frame that is too long")
        self.advance()
        # a radio starts its frame on multiples of 512, and the antenna's true delay comes on top
        leaves_ticks = wrap(message.tx_ticks - client.wrong_ticks[message.node])
        is_planned = node not in self._flying and self.medium.transmit(node, Transmission(message.frame, leaves_ticks))
        if is_planned:
            self._flying[node] = message.tx_ticks
            self._arm()
        else:
            client.send(wire.Done(message.node, message.tx_ticks, late=True))

    def _deliver(self, delivery: Delivery) -> None:
        """Send a completed frame to all processes whose nodes heard it, and its end to the sender."""
        flight, host_s = delivery.flight, self.now_host_s
        rows: dict[Client, list[wire.HeardRow]] = {}
        for heard in (delivery.by_anchors, delivery.by_tags):
            for node, *values in zip(*(heard[column].tolist() for column in self._columns), strict=True):
                owner = self._owners.get(node)
                if owner is not None:
                    rows.setdefault(owner, []).append(wire.HeardRow(owner.index[node], *values))
        for owner, heard_rows in rows.items():
            if not owner.send(wire.Arrival(flight.frame, host_s, tuple(heard_rows))):
                self.overruns += len(heard_rows)
        if flight.boot != self.medium.boots[flight.sender]:
            return  # the process that sent it has left meanwhile
        sender = self._owners.get(flight.sender)
        tx_ticks = self._flying.pop(flight.sender, None)
        if sender is not None and tx_ticks is not None:
            sender.send(wire.Done(sender.index[flight.sender], tx_ticks, late=False))

    # Truth and health

    def truth(self, unix_less_host_s: float) -> TruthMessage:
        """Return the true motion of the tags on the air. ``unix_less_host_s`` is Unix time minus the host's."""
        now_s, unix_s = self.medium.now_s, self.now_host_s + unix_less_host_s
        motions = {}
        for name, trajectory in self._tags.items():
            if self._nodes["tag", name] in self._owners:
                position, velocity = trajectory.position(now_s), trajectory.velocity(now_s)
                motions[name] = TrueMotion(vector(position.tolist()), vector(velocity.tolist()))
        return TruthMessage(unix_s, motions)

    def health(self, unix_s: float) -> EtherHealth:
        """Return the counts so far; call this once a second."""
        tally = self.medium.tally
        missed = tally.late_transmissions + self._missed
        sent_before, missed_before = self._reported
        self._reported = tally.transmissions, missed
        new_missed = missed - missed_before
        planned = tally.transmissions - sent_before + new_missed
        return EtherHealth(
            unix_s,
            self.medium.now_s,
            tally.transmissions,
            missed,
            tally.at_anchors,
            tally.at_tags,
            self.stalls,
            self.overruns,
            missed_share=new_missed / planned if planned else 0.0,
        )


class EtherNode:
    """An ether listening at an address, with an MQTT connection for truth and health."""

    def __init__(self, ether: Ether, host: str, port: int, address: MqttAddress | None, log: Log) -> None:
        self._ether, self._host, self._port, self._log = ether, host, port, log
        self._site = ether.site.id
        self._link = link_of(address, "air", site=self._site, kind="ether")

    async def run(self) -> None:
        """Serve until cancelled. Raises OSError if the address cannot be listened on."""
        server = await self._ether.serve(self._host, self._port, self._log)
        host, port = server.sockets[0].getsockname()[:2]
        self._log(f"ether at {f'[{host}]' if ':' in host else host}:{port}")
        async with server:
            parts = [self._ether.send_clocks()]
            if self._link is not None:
                publish, truth = self._link.publish, truth_topic(self._site)
                health = health_topic(self._site, "ether", "air")
                parts += [
                    keep(self._link, self._log),
                    every(_TRUTH_S, lambda: publish(truth, self._ether.truth(time.time() - time.monotonic()))),
                    every(HEALTH_S, lambda: publish(health, self._ether.health(time.time()))),
                ]
            await together(*parts)
