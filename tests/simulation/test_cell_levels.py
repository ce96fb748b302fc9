"""Both levels of several cells give the same bits: machines on ``CellMedium``, and the kernels of ``CellWorld``."""

import numpy as np
import pytest
from beaconing import FRAME_BYTES, FreeAnchor, SlotAnchor, contents

from skyless.simulation.cells.medium import CellMedium
from skyless.simulation.cells.timetable import FreeSchedule
from skyless.simulation.cells.world import CellWorld, anchors_of
from skyless.simulation.channel import ChannelModel
from skyless.simulation.impairments import Impairments
from skyless.simulation.oscillator import OscillatorModel
from skyless.simulation.stations import TagSpec
from skyless.simulation.trajectory import Roaming, Static, Waypoints
from skyless.simulation.world import World
from skyless.site.free_access import free_window_ticks
from skyless.site.model import AnchorSite, Site
from skyless.ticks import from_seconds

RATE_HZ = 30.0
UNTIL_S = 1.5
IMPAIRMENTS = Impairments(channel=ChannelModel(loss_probability=0.05))
SITE = Site(
    name="sixty",
    id=1,
    master=100,
    anchors=tuple(AnchorSite(100 + 3 * k, 12.0 * (k % 10), 13.0 * (k // 10), 3.0 + 0.1 * k) for k in range(60)),
)


def tags():
    return [
        Static(50.0, 40.0, 1.0),
        Waypoints([(5, 5, 1), (90, 60, 1), (30, 10, 1)], 4.0, loop=True, corner_s=0.5),
        Roaming((40.0, 30.0, 1.2), (10.0, 10.0, 0.1), seed=3),
        Static(300.0, 300.0, 1.0),
    ]


def machines_world(make, impairments):
    """Machines by identifier, frames as (anchor, sequence, TX stamp), and rows of each tag."""
    machines = {}

    def factory(anchor):
        machines[anchor] = make(anchor)
        return machines[anchor]

    world = World(SITE, factory, [TagSpec(tag) for tag in tags()], impairments, 3, medium=CellMedium)
    frames, rows = [], [[] for _ in tags()]
    for broadcast in world.run(UNTIL_S + 0.01):
        if broadcast.emission_ticks < from_seconds(UNTIL_S):
            frames.append(contents(broadcast.frame)[:3])
            emitted = (broadcast.emission_ticks, broadcast.emission_fraction)
            for tag, reception, position_m in broadcast.receptions():
                rows[tag].append((*emitted, reception.rx_ticks, contents(reception.frame), tuple(position_m.tolist())))
    return machines, frames, [sorted(one) for one in rows], world


def rows_of(received):
    """The same rows from the kernels' columns."""
    relays = np.stack((received.relay_anchor, received.relay_sequence, received.relay_rx_ticks), axis=2).tolist()
    columns = (received.anchor, received.sequence, received.tx_ticks)
    beacons = zip(*(column.tolist() for column in columns), relays, received.relays.tolist(), strict=True)
    contained = [(*head, tuple(map(tuple, few[:count]))) for *head, few, count in beacons]
    emitted = (received.emission_ticks, received.emission_fraction, received.rx_ticks)
    positions = map(tuple, received.positions_m.tolist())
    return list(zip(*(column.tolist() for column in emitted), contained, positions, strict=True))


def logs_of(received):
    """Receptions by listener, in the order of emission."""
    logs = {}
    columns = (received.listener, received.anchor, received.sequence, received.rx_ticks)
    for listener, *row in zip(*(column.tolist() for column in columns), strict=True):
        logs.setdefault(listener, []).append(tuple(row))
    return logs


@pytest.fixture(scope="module")
def free():
    window_ticks = free_window_ticks(RATE_HZ)
    machines, frames, rows, world = machines_world(lambda anchor: FreeAnchor(anchor, window_ticks), IMPAIRMENTS)
    kernels = CellWorld(anchors_of(SITE), FreeSchedule(RATE_HZ), tags(), IMPAIRMENTS, 3, frame_bytes=FRAME_BYTES)
    return machines, frames, rows, world, kernels


def test_all_outcomes_occur(free):
    tally = free[3].tally
    assert min(tally.at_anchors.values()) > 0
    assert tally.late_transmissions == 0
    assert len(free[1]) == pytest.approx(60 * RATE_HZ * UNTIL_S, abs=60)


def test_tags_receive_the_same_frames_with_the_same_stamps_and_relays(free):
    _, _, rows, _, kernels = free
    for tag, expected in enumerate(rows):
        parts = [kernels.receptions(tag, begin_s, begin_s + 0.5) for begin_s in (0.0, 0.5, 1.0)]
        assert [row for part in parts for row in rows_of(part)] == expected
    assert len(rows[0]) > 100
    assert any(len(row[3][3]) == 6 for row in rows[0])
    assert not rows[3], "out of range"


def test_anchors_receive_the_same_frames_with_the_same_stamps(free):
    machines, frames, _, _, kernels = free
    received = kernels.anchor_receptions(range(60), 0.0, UNTIL_S)
    logs = logs_of(received)
    for anchor, machine in machines.items():
        assert len(logs[anchor]) > 100
        assert machine.log[: len(logs[anchor])] == logs[anchor]
        assert len(machine.log) - len(logs[anchor]) < 20, "received in the last 10 ms"
    columns = (received.anchor, received.sequence, received.tx_ticks)
    assert set(zip(*(column.tolist() for column in columns), strict=True)) <= set(frames)


def test_frames_of_slots_that_machines_sent_are_received_alike():
    """Slots shared by anchors 26 m apart and more, by clocks that part by up to 0.6 µs: early first paths occur."""
    crystals = OscillatorModel(offset_ppm=0.2)
    impairments = Impairments(oscillator=crystals)
    slot_ticks, slots = from_seconds(1e-3), 12

    def make(anchor):
        column, row = (anchor - 100) // 3 % 10, (anchor - 100) // 30
        return SlotAnchor(anchor, slots * slot_ticks, colour=column % 4 + 4 * (row % 3), slot_ticks=slot_ticks)

    machines, _, rows, world = machines_world(make, impairments)
    assert world.tally.late_transmissions == 0
    senders, tx_ticks = zip(*((k, t) for k, one in enumerate(machines.values()) for t in one.sent), strict=True)
    for first_path_db in (20.0, 10.0):
        kernels = CellWorld(anchors_of(SITE), FreeSchedule(), tags(), impairments, 3, frame_bytes=FRAME_BYTES)
        kernels._rules = kernels._rules._replace(first_path=10.0 ** (first_path_db / 10.0))
        by_anchors, by_tags = kernels.receptions_of(np.array(senders), np.array(tx_ticks), 0.0, UNTIL_S)
        computed, logs = [rows_of(one) for one in by_tags], logs_of(by_anchors)
        alike = computed == rows
        assert alike == (first_path_db == 20.0), "a narrower rule leaves stamps alone that another frame shifts"
        for anchor, machine in machines.items():
            received = logs.get(anchor, [])
            assert [row[:2] for row in machine.log[: len(received)]] == [row[:2] for row in received]
            assert not alike or machine.log[: len(received)] == received
