"""Compile the kernels before a clock runs: the first time takes seconds, later ones load them from disk."""

from math import dist

from skyless.core.air.masterless_packets import Packet, PairTdoa, Relay
from skyless.core.constants import TICK_M
from skyless.core.method_names import DEFAULT_METHOD, FILTERS
from skyless.core.ticks import from_seconds, wrap
from skyless.research.masterless.difference_tracking import DIFFERENCES, DifferenceTracking
from skyless.research.masterless.packet_tracking import MASTERLESS, PacketTracking
from skyless.sim.evaluation.fleet import Fleet, FleetSettings
from skyless.sim.impairments import lab_impairments
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.sim.trajectory import Static


def compile_kernels(method: str = DEFAULT_METHOD) -> None:
    """Run a fifth of a second of the lab; for snapshots that of the paper, as they need its protocol."""
    site = lab_site() if method in FILTERS else paper_lab_site()
    fleet = Fleet(site, [Static(3.0, 4.0)], lab_impairments(100.0), 0, FleetSettings(method, warmup_s=0.0))
    for _ in fleet.run(0.2):
        pass


def compile_pair_kernels() -> None:
    """Start a filter of pair differences and run it on some measurements."""
    anchors_m = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in lab_site().anchors}
    tracking = DifferenceTracking(DIFFERENCES.changed(height_m=0.0), anchors_m)
    tag_m = (2.0, 3.0, 0.0)
    for k in range(24):
        a, b = 1 + k % 6, 1 + (k + 1) % 6
        tracking.update((PairTdoa(0.01 * k, a, b, dist(tag_m, anchors_m[b]) - dist(tag_m, anchors_m[a])),))


def compile_packet_kernels() -> None:
    """Start ``joint`` on packets of anchors whose clocks agree, each of which received the one before it."""
    anchors_m = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in lab_site().anchors}
    names = list(anchors_m)
    tracking = PacketTracking(MASTERLESS.changed(height_m=0.0), anchors_m)
    heard: tuple[Relay, ...] = ()
    for k in range(4 * len(names)):
        anchor, follower = names[k % len(names)], names[(k + 1) % len(names)]
        sequence, tx_ticks = k // len(names), from_seconds(0.002 * k)
        rx_ticks = tx_ticks + round(dist((2.0, 3.0, 0.0), anchors_m[anchor]) / TICK_M)
        tracking.on_packet(Packet(None, anchor, sequence, wrap(tx_ticks, 32), rx_ticks, heard))
        flight = round(dist(anchors_m[anchor], anchors_m[follower]) / TICK_M)
        heard = (Relay(anchor, sequence, wrap(tx_ticks + flight, 32), flight),)
