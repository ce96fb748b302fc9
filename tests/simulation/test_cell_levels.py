"""Both levels of several cells give the same bits: machines on ``CellMedium``, and the kernels of ``CellWorld``."""

import numpy as np
import pytest
from beaconing import FRAME_BYTES, FreeAnchor, contents

from skyless.core.air.almanac import period_code, period_ticks
from skyless.core.site import AnchorSite, Site
from skyless.core.ticks import from_seconds, to_seconds
from skyless.sim.cells.world import CellWorld, anchors_of
from skyless.sim.impairments import Impairments
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Roaming, Static, Waypoints
from skyless.site.channel import ChannelModel
from support.cell_medium import cell_world

pytestmark = pytest.mark.statistical

CODES = np.array([period_code(1.0 / rate_hz) for rate_hz in np.linspace(20.0, 40.0, 60)])
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
    """Frames as (anchor, sequence, TX stamp), and rows of each tag."""
    world = cell_world(SITE, make, [TagSpec(tag) for tag in tags()], impairments, 3)
    frames, rows = [], [[] for _ in tags()]
    for broadcast in world.run(UNTIL_S + 0.01):
        if broadcast.emission_ticks < from_seconds(UNTIL_S):
            frames.append(contents(broadcast.frame)[:3])
            emitted = (broadcast.emission_ticks, broadcast.emission_fraction)
            for tag, reception, position_m in broadcast.receptions():
                rows[tag].append((*emitted, reception.rx_ticks, contents(reception.frame), tuple(position_m.tolist())))
    return frames, [sorted(one) for one in rows], world


def rows_of(received):
    """The same rows from the kernels' columns."""
    relays = np.stack((received.relay_anchor, received.relay_sequence, received.relay_rx_ticks), axis=2).tolist()
    columns = (received.anchor, received.sequence, received.tx_ticks)
    beacons = zip(*(column.tolist() for column in columns), relays, received.relays.tolist(), strict=True)
    contained = [(*head, tuple(map(tuple, few[:count]))) for *head, few, count in beacons]
    emitted = (received.emission_ticks, received.emission_fraction, received.rx_ticks)
    positions = map(tuple, received.positions_m.tolist())
    return list(zip(*(column.tolist() for column in emitted), contained, positions, strict=True))


@pytest.fixture(scope="module")
def free():
    codes = dict(zip((anchor.id for anchor in SITE.anchors), CODES.tolist(), strict=True))
    frames, rows, world = machines_world(lambda anchor: FreeAnchor(anchor, codes[anchor]), IMPAIRMENTS)
    kernels = CellWorld(anchors_of(SITE), CODES, tags(), IMPAIRMENTS, 3, frame_bytes=FRAME_BYTES)
    return frames, rows, world, kernels


def test_all_outcomes_occur(free):
    tally = free[2].tally
    assert min(tally.at_anchors.values()) > 0
    assert tally.late_transmissions == 0
    rates_hz = [1.0 / to_seconds(period_ticks(code)) for code in CODES.tolist()]
    assert len(free[0]) == pytest.approx(sum(rates_hz) * UNTIL_S, abs=60)


def test_tags_receive_the_same_frames_with_the_same_stamps_and_relays(free):
    _, rows, _, kernels = free
    for tag, expected in enumerate(rows):
        parts = [kernels.receptions(tag, begin_s, begin_s + 0.5) for begin_s in (0.0, 0.5, 1.0)]
        assert [row for part in parts for row in rows_of(part)] == expected
    assert len(rows[0]) > 100
    assert any(len(row[3][3]) == 6 for row in rows[0])
    assert not rows[3], "out of range"
