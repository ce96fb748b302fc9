"""A tag's receiver in Python and in C: the same bits after every frame, also of forged, repeated and damaged ones."""

import numpy as np
import pytest
from msgspec.structs import replace
from test_same_bits import bits

from skyless.core.air.beacon import decode, encode
from skyless.core.air.frame import Diagnostics, PackedHeard
from skyless.core.air.site_pages import site_issue
from skyless.core.anchor import site_page_for, site_pages_of
from skyless.core.tag import receiver
from skyless.core.tag.hearing import hear_frame
from support.bench import ROOM, tape

pytestmark = pytest.mark.site

FREE = replace(ROOM, schedule=replace(ROOM.schedule, mode="free", rate_hz=60.0))
PHASES = replace(FREE, schedule=replace(FREE.schedule, carrier_phase=True))


OTHERS = site_pages_of(replace(FREE, tags=replace(FREE.tags, height_m=0.1)))
"""Pages by which the height is known."""


def surveyed(received):
    """A beacon half a metre from where it was, with other pages."""
    beacon = decode(received.frame)
    page = site_page_for(OTHERS, beacon.sequence, beacon.anchor)
    position = replace(beacon.position, x_m=beacon.position.x_m + 0.5)
    changed = replace(beacon, position=position, almanac_issue=site_issue(OTHERS), page=page)
    return replace(
        received, frame=encode(replace(changed, heard=PackedHeard(beacon.heard.packed[:32], beacon.has_phases), weak=0))
    )


def disturbed(heard, draw):
    """Frames repeated, damaged, under other names or sites, with other stamps; a survey; a counter that restarts."""
    after = len(heard) // 3
    for number, received in enumerate([*heard[:after], *map(surveyed, heard[after:])]):
        beacon, change = decode(received.frame), draw.random()
        powers = Diagnostics(-80.0, -80.0 - 14.0 * draw.random())
        one = replace(received, diagnostics=powers)
        if number > 0.8 * len(heard):  # five seconds back
            one = replace(one, rx_ticks=(one.rx_ticks - 3 * 10**11) % 2**40, host_s=None)
        yield one
        if change < 0.05:
            yield one
        elif change < 0.1:
            yield replace(one, frame=one.frame[:-1] + b"\0", rx_ticks=one.rx_ticks + 10)
        elif change < 0.2:
            forged = replace(beacon, tx_ticks=int(draw.integers(2**40)), anchor=int(draw.integers(1, 12)), heard=())
            yield replace(one, frame=encode(replace(forged, weak=0)), rx_ticks=one.rx_ticks + 10**6)
        elif change < 0.25:
            yield replace(one, frame=encode(replace(beacon, site=77)), rx_ticks=one.rx_ticks + 10**6)
        elif change < 0.3:
            yield replace(one, rx_ticks=one.rx_ticks + 10**6, host_s=1e300)


@pytest.mark.parametrize("site", [FREE, PHASES], ids=["stamps", "phases"])
def test_a_receiver_gives_the_same_bits(monkeypatch, site):
    draw = np.random.default_rng(4)
    compiled, plain = receiver.Receiver(), receiver.Receiver()
    fixes = 0
    for one in disturbed([one.reception for one in tape(site, 1.2)], draw):
        expected = compiled.hear(one)
        with monkeypatch.context() as patched:
            patched.setattr(receiver, "_hear_frame", hear_frame)
            found = plain.hear(one)
        assert (None if found is None else (found.rows, found.time_s, found.anchors)) == (
            None if expected is None else (expected.rows, expected.time_s, expected.anchors)
        )
        assert bits(plain.tag) == bits(compiled.tag)
        assert (plain.reason, plain.counters) == (compiled.reason, compiled.counters)
        fixes += found is not None
    assert fixes > 100
    assert plain.almanac.pages.site.tag_height_m == 0.1
    counted = {
        "moved-anchor",
        "duplicate",
        "bad-fcs",
        "impossible-stamp",
        "foreign-site",
        "impossible-host-time",
        "counter-jump",
    }
    assert counted <= plain.counters.keys()
