"""Which slot length suits a Raspberry Pi: the table of docs/hardware.md. Simulated; some minutes.

python benchmarks/host_latency.py [SECONDS [SEEDS [SLOT_MS ...]]] [--lead-ms 1.8 ...]

A site whose anchors and tag are DW1000s on the SPI of slow hosts. Hosts run the driver
(``skyless.radio.dw1000.driver``) on the register model; every transfer costs time, in which the air and the other
hosts go on. Frames that come too late are skipped, and cost their slots. ``--lead-ms``: anchors keep to this lead
instead of adapting theirs.
"""

import argparse
import math
import random
from collections.abc import Sequence
from typing import Final

import numpy as np
from delayed_hosts import AnchorHost, Host, TagHost
from emulator.site.host_programs import HostLatency
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from skyless.core.air.frame import Reception
from skyless.core.protocol1.beacon import Beacon, decode_cached
from skyless.core.site import ScheduleSite, Site
from skyless.core.ticks import wrap
from skyless.research.uncertainty.bounds import BoundSettings, received_bound
from skyless.sim.evaluation.scenarios import Request, impairments_of, trajectories_of
from skyless.sim.lab import paper_lab_site
from skyless.sim.medium import Delivery, Medium
from skyless.sim.stations import TagSpec
from skyless.sim.world import diagnostics_of

_SLOTS_MS: Final = (1.05, 2.1, 2.5, 5.0, 10.0)
_QA: Final = 0.3
_SPEED_STD_MPS: Final = 1.0
_WARMUP_S: Final = 3.0
_TURNAROUND_S: Final = 10e-6
"""The chips themselves decide whether a frame is too late."""


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
    """Run the lab on such hosts for some seconds, ``_WARMUP_S`` included; ``lead_s``: a lead that anchors keep to."""
    world = LatencyWorld(slot_s, latency, seed, lead_s)
    world.run(seconds)
    sent = {slot: position_m for slot, time_s, position_m in world.sent_frames if time_s >= _WARMUP_S}
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


def main() -> None:
    """Print the table, or the one of leads."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seconds", type=float, nargs="?", default=10.0)
    parser.add_argument("seeds", type=int, nargs="?", default=4)
    parser.add_argument("slots_ms", type=float, nargs="*", default=_SLOTS_MS)
    parser.add_argument("--lead-ms", type=float, nargs="+")
    asked = parser.parse_args()
    least_s = _WARMUP_S + 1.0
    if not least_s <= asked.seconds < math.inf or asked.seeds < 1:
        parser.error(f"SECONDS should be at least {least_s:g}, SEEDS at least 1")
    if asked.lead_ms:
        _print_leads(asked.lead_ms, asked.slots_ms, asked.seconds, asked.seeds)
        return
    heads = (
        "slot",
        "messages/s",
        "skipped",
        "tag heard",
        "anchors heard",
        "error",
        "bound",
        "ratio",
        "without latency",
    )
    _print_heads(heads)
    for slot_ms in asked.slots_ms:
        results = runs(slot_ms, HostLatency(), asked.seconds, asked.seeds)
        error_m, bound_m = rms(results)
        ideal_m, ideal_bound_m = rms(runs(slot_ms, HostLatency.none(), asked.seconds, asked.seeds))
        sent, slots = (sum(getattr(result, name) for result in results) for name in ("sent", "slots"))
        heard, relayed = (np.mean([getattr(result, name) for result in results]) for name in ("heard", "relayed"))
        print(
            f"| {slot_ms:g} ms | {sent / slots / slot_ms * 1e3:.0f} | {100 * (1 - sent / slots):.2f} % "
            f"| {100 * heard:.1f} % | {100 * relayed:.1f} % | {100 * error_m:.2f} cm | {100 * bound_m:.2f} cm "
            f"| {error_m / bound_m:.2f} | {ideal_m / ideal_bound_m:.2f} |",
            flush=True,
        )


def _print_leads(leads_ms: Sequence[float], slots_ms: Sequence[float], seconds: float, seeds: int) -> None:
    _print_heads(("slot", "lead", "skipped", "anchors heard", "error"))
    for slot_ms in slots_ms:
        for lead_ms in leads_ms:
            results = runs(slot_ms, HostLatency(), seconds, seeds, 1e-3 * lead_ms)
            skipped, relayed = (np.mean([getattr(one, name) for one in results]) for name in ("skipped", "relayed"))
            print(
                f"| {slot_ms:g} ms | {lead_ms:g} ms | {100 * skipped:.2f} % | {100 * relayed:.1f} % "
                f"| {100 * rms(results)[0]:.2f} cm |",
                flush=True,
            )


def _print_heads(heads: Sequence[str]) -> None:
    print(f"| {' | '.join(heads)} |")
    print("|---" * len(heads) + "|")


def runs(
    slot_ms: float, latency: HostLatency, seconds: float, seeds: int, lead_s: float | None = None
) -> list[LatencyResult]:
    """One run for each seed; none with a wrong stamp."""
    results = [run_hosts(1e-3 * slot_ms, latency, seconds, seed, lead_s) for seed in range(1, seeds + 1)]
    assert not any(result.wrong_stamps or result.misused for result in results)
    return results


def rms(results: list[LatencyResult]) -> tuple[float, float]:
    """Error and bound over all fixes."""
    weights = [result.fixes for result in results]
    squares = [(result.rms_m**2, result.bound_m**2) for result in results]
    error_m, bound_m = np.sqrt(np.average(squares, axis=0, weights=weights))
    return float(error_m), float(bound_m)


if __name__ == "__main__":
    main()
