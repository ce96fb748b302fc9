"""A site whose anchors and tag are DW1000s on the SPI of slow hosts, as a Raspberry Pi, in the simulated world's time.

Hosts run the driver (``skyless.radio.dw1000.radio``) on the register model; every transfer costs time, in which the
air and the other hosts go on.
"""

import random
from collections import Counter
from typing import Any, Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from emulator.site.host_programs import HostLatency, Process
from emulator.site.site_air import NodeAir
from skyless.core.air.frame import Diagnostics, Reception
from skyless.core.any_receiver import AnyReceiver
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.protocol1.anchor import Anchor
from skyless.core.protocol1.beacon import Beacon, decode_cached
from skyless.core.site import ScheduleSite, Site
from skyless.core.ticks import TICK_S, difference, wrap
from skyless.radio.dw1000.radio import SPI_LEAD_S, ChipSession
from skyless.radio.interface import AntennaDelays, Late, RadioEvent, Sent
from skyless.research.uncertainty import BoundSettings, received_bound
from skyless.run.anchor import ASK_AGAIN_S, LEAD_GAIN, LEAD_LOSS, MAX_LEAD_S
from skyless.sim.dw1000.chip import Chip, ModelBus
from skyless.sim.evaluation.scenarios import Request, impairments_of, trajectories_of
from skyless.sim.lab import paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.medium import Delivery, Medium
from skyless.sim.world import diagnostics_of

WARMUP_S: Final = 3.0
_QA: Final = 0.3
_SPEED_STD_MPS: Final = 1.0
_TURNAROUND_S: Final = 10e-6
"""The chips themselves decide whether a frame is too late."""
_POLL_S: Final = 20e-3
_COMING: Final = 64
"""Frames that a host may still be about to fetch."""


class Host:
    """A computer with a chip on its SPI."""

    def __init__(self, medium: Medium[Any], node: int, latency: HostLatency, generator: random.Random) -> None:
        self.medium, self.latency, self.generator = medium, latency, generator
        self.air = NodeAir(medium, node)
        delays = AntennaDelays()
        self.chip = Chip(self.air, delays.tx_ticks, delays.rx_ticks, self.air.now_s)
        self.counters: Counter[str] = Counter()
        self.heard: set[int] = set()
        """Slots whose frames the program received."""
        self._coming: dict[bytes, tuple[int, NDArray[np.float64]]] = {}
        bus = ModelBus(self.chip, self._spend, lambda: latency.draw(generator))
        self.session = ChipSession(bus, delays, self.hear, self.counters)
        self.process = Process(medium.timeline, self.program)

    @property
    def misused(self) -> int:
        """Events that should never happen."""
        return self.chip.misuse.total() + self.air.counts.total() + self.counters["sent-at-another-time"]

    def _spend(self, seconds: float) -> None:
        self.process.sleep(seconds)

    # The air

    def arrive(self, reception: Reception, slot: int, position_m: NDArray[np.float64]) -> None:
        """A frame has ended at the antenna."""
        self._coming[reception.frame] = (slot, position_m)
        if len(self._coming) > _COMING:
            del self._coming[next(iter(self._coming))]
        self.chip.receive(reception.frame, reception.rx_ticks, reception.diagnostics or Diagnostics())
        if self.chip.irq:
            self.process.notify()

    def finish(self) -> None:
        """The own frame has ended."""
        self.chip.transceiver.finish()
        if self.chip.irq:
            self.process.notify()

    # The program

    def program(self) -> None:
        """The host's program; never returns."""
        raise NotImplementedError

    def serve(self, seconds: float) -> None:
        """Wait for the interrupt line for some seconds, and serve it."""
        self.process.wait(seconds)
        while self.chip.irq:
            self.process.sleep(self.latency.draw(self.generator))  # until the program runs
            self.session.serve(self.medium.now_s)

    def work(self, reception: Reception) -> tuple[int, NDArray[np.float64]]:
        """Spend the time that a frame costs to be processed; its slot, and the tag's position."""
        self.process.sleep(self.latency.work_s)
        slot, position_m = self._coming[reception.frame]
        self.heard.add(slot)
        return slot, position_m

    def hear(self, event: RadioEvent) -> None:
        """An event of the session."""
        raise NotImplementedError


class AnchorHost(Host):
    """An anchor's, which does what ``run/anchor.py`` does: hands frames over earlier after a late one."""

    def __init__(
        self,
        medium: Medium[Any],
        site: Site,
        node: int,
        latency: HostLatency,
        generator: random.Random,
        lead_s: float | None,
    ) -> None:
        """``lead_s``: the lead that it keeps to; None for one that adapts."""
        self.lead_s = SPI_LEAD_S if lead_s is None else lead_s
        self.machine = Anchor(site, site.anchors[node].id, lead_s=self.lead_s)
        self._adapts = lead_s is None
        self.late = 0
        self._answered = True
        self._wait_s = 0.0
        super().__init__(medium, node, latency, generator)

    def program(self) -> None:
        """Receive others, and send in its slots."""
        self.session.start()
        while True:
            now_ticks = self.session.read_ticks()
            tx_ticks = None if now_ticks is None else self.machine.next_transmission_ticks(now_ticks)
            if tx_ticks is None:
                self.serve(ASK_AGAIN_S)
                continue
            self._serve_until(tx_ticks)
            self.process.sleep(self.latency.work_s)
            self._answered = False
            self.session.transmit(self.machine.transmission(tx_ticks), self.medium.now_s)
            self._await_answer()
            if self._wait_s:
                self.serve(self._wait_s)
                self._wait_s = 0.0

    def _serve_until(self, tx_ticks: int) -> None:
        """Receive others until the frame is to be handed over."""
        while (ahead_s := difference(tx_ticks, self.air.now_ticks()) * TICK_S - self.lead_s) > 0.0:
            self.serve(ahead_s + 1e-6)

    def _await_answer(self) -> None:
        while not self._answered:
            overdue = self.session.overdue_ticks
            ahead_s = _POLL_S if overdue is None else difference(overdue, self.air.now_ticks()) * TICK_S
            if ahead_s <= 0.0:
                self.session.cancel_overdue()
            self.serve(max(ahead_s, 0.0) + 1e-6)

    def hear(self, event: RadioEvent) -> None:
        """A frame of another anchor, or the result of its own."""
        if isinstance(event, Reception):
            self.work(event)
            self.machine.hear(event)
        elif isinstance(event, Sent):
            self._answered = True
            if self._adapts:
                self.lead_s = max(self.lead_s * LEAD_LOSS, SPI_LEAD_S)
        elif isinstance(event, Late):
            self._answered = True
            self.late += 1
            if self._adapts:
                self.lead_s = min(self.lead_s * LEAD_GAIN, MAX_LEAD_S)
            self._wait_s = ASK_AGAIN_S


class TagHost(Host):
    """A tag's."""

    def __init__(
        self, medium: Medium[Any], node: int, latency: HostLatency, generator: random.Random, qa: float
    ) -> None:
        self.receiver = AnyReceiver(DEFAULT_METHOD, qa=qa)
        self.errors_m2: list[tuple[int, float]] = []
        """Slot and squared error of every fix."""
        super().__init__(medium, node, latency, generator)

    def program(self) -> None:
        """Listen."""
        self.session.start()
        while True:
            self.serve(_POLL_S)

    def hear(self, event: RadioEvent) -> None:
        """A frame."""
        if isinstance(event, Reception):
            slot, position_m = self.work(event)
            fix = self.receiver.hear(event)
            if fix is not None:
                self.errors_m2.append((slot, float(np.sum((fix.position_m - position_m)[:2] ** 2))))


class LatencyResult(Struct, frozen=True):
    """One run."""

    slot_s: float
    slots: int
    """Slots after the warm-up."""
    sent: int
    """Frames in them."""
    late: int
    """Frames that came too late for their radios, in the whole run; none of them was sent."""
    wrong_stamps: int
    """Frames that left at another time than the one that they state."""
    misused: int
    """Uses of chips that the manual forbids, and frames that were sent although they were cancelled."""
    heard: float
    """Share of the frames sent that the tag received."""
    relayed: float
    """Share of the frames sent that anchors received, on average over those that could."""
    fixes: int
    rms_m: float
    """Error of the position (2-D), root mean square over all fixes."""
    bound_m: float
    """The posterior Cramér-Rao bound for the messages that were received, at the same instants."""

    @property
    def skipped(self) -> float:
        """Share of the slots without a frame."""
        return 1.0 - self.sent / self.slots


class LatencyWorld:
    """The lab with another slot length on such hosts, deterministic by its seed."""

    def __init__(self, slot_s: float, latency: HostLatency, seed: int, lead_s: float | None) -> None:
        lab = paper_lab_site()
        self.site = replace(lab, schedule=ScheduleSite(slot_s=slot_s))
        request = Request(self.site, seed=seed)
        self.trajectory = trajectories_of(request)[0]
        faults = replace(impairments_of(request, self.site), diagnostics=True)
        self.medium: Medium[None] = Medium(
            self.site, [TagSpec(self.trajectory)], faults, seed, self._deliver, _TURNAROUND_S
        )
        generators = [random.Random(f"{seed} {node}") for node in range(len(self.site.anchors) + 1)]
        for node in range(len(generators)):
            self.medium.switch_on(node)
        self.anchors = [
            AnchorHost(self.medium, self.site, node, latency, generators[node], lead_s)
            for node in range(len(self.site.anchors))
        ]
        self.tag = TagHost(self.medium, len(self.anchors), latency, generators[-1], _QA)
        self.hosts: list[Host] = [*self.anchors, self.tag]
        self.sent_frames: list[tuple[int, float, NDArray[np.float64]]] = []
        """Slot (counted from the first superframe), time and the tag's position of every frame that was sent."""
        self.wrong_stamps = 0

    def run(self, seconds: float) -> None:
        """Run for some seconds, and end all programs."""
        try:
            for _ in self.medium.run(seconds):
                pass
        finally:
            for host in self.hosts:
                host.process.close()

    def _deliver(self, delivery: Delivery) -> None:
        """A frame has ended: notify its sender, and pass it to the chips that can receive it."""
        flight = delivery.flight
        beacon = decode_cached(flight.frame)
        assert isinstance(beacon, Beacon)
        self.wrong_stamps += beacon.tx_ticks != wrap(flight.marker_local_ticks)
        slot = beacon.superframe * len(self.anchors) + flight.sender
        position_m = self.trajectory.position(self.medium.now_s)
        self.sent_frames.append((slot, self.medium.now_s, position_m))
        self.hosts[flight.sender].finish()
        for rows in (delivery.by_anchors, delivery.by_tags):
            for row in rows:
                reception = Reception(flight.frame, int(row["rx_ticks"]), self.medium.now_s, diagnostics_of(row))
                self.hosts[int(row["node"])].arrive(reception, slot, row["position_m"].copy())


def run_hosts(
    slot_s: float, latency: HostLatency, seconds: float, seed: int = 1, lead_s: float | None = None
) -> LatencyResult:
    """Run the lab on such hosts for some seconds, ``WARMUP_S`` included; ``lead_s``: a lead that anchors keep to."""
    world = LatencyWorld(slot_s, latency, seed, lead_s)
    world.run(seconds)
    sent = {slot: position_m for slot, time_s, position_m in world.sent_frames if time_s >= WARMUP_S}
    first, last = min(sent), max(sent)
    n = len(world.anchors)
    first += -first % n
    slots = last - last % n - first
    inside = {slot for slot in sent if first <= slot < first + slots}
    heard = np.zeros((slots, n + 1), bool)
    for column, host in enumerate(world.hosts):
        for slot in host.heard & inside:
            heard[slot - first, column] = True
    errors_m2 = {slot: error_m2 for slot, error_m2 in world.tag.errors_m2 if slot in inside}
    traces = _bound(world.site, world, heard, first)
    at = np.array(sorted(errors_m2), dtype=int) - first
    judged = at[at * world.site.schedule.slot_s > 1.0]
    return LatencyResult(
        slot_s=slot_s,
        slots=slots,
        sent=len(inside),
        late=sum(host.late for host in world.anchors),
        wrong_stamps=world.wrong_stamps,
        misused=sum(host.misused for host in world.hosts),
        heard=float(heard[:, -1].sum() / len(inside)),
        relayed=float(heard[:, :-1].sum() / (len(inside) * (n - 1))),
        fixes=len(judged),
        rms_m=float(np.sqrt(np.mean([errors_m2[int(slot) + first] for slot in judged]))),
        bound_m=float(np.sqrt(traces[judged].mean())),
    )


def _bound(site: Site, world: LatencyWorld, heard: NDArray[np.bool_], first: int) -> NDArray[np.float64]:
    """Trace of the bound at each slot, of what hosts received; it begins without any knowledge."""
    n, slot_s, noise = len(site.anchors), site.schedule.slot_s, site.noise
    known = heard.copy()
    of_others = np.arange(len(heard)) % n != 0
    known[:, :-1] &= ~of_others[:, None] | heard[:, -1:]
    begun_s = min(time_s - (slot - first) * slot_s for slot, time_s, _ in world.sent_frames if slot >= first)
    path_m = np.array([world.trajectory.position(begun_s + slot * slot_s) for slot in range(len(heard))])
    settings = BoundSettings(
        noise.rx_stamp_ps * 1e-12,
        white_fm=noise.white_fm,
        random_walk_fm=noise.random_walk_fm,
        qa=_QA,
        slot_s=slot_s,
        speed_std_mps=_SPEED_STD_MPS,
        mesh=True,
    )
    anchors_m = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors])
    traces: NDArray[np.float64] = np.trace(received_bound(anchors_m, path_m, settings, known), axis1=1, axis2=2)
    return traces
