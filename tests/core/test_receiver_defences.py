"""What a tag of protocol 2 keeps when its counter restarts, an anchor's row is lost, or strangers were there first."""

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.core.air.beacon import Beacon, StatedPosition, decode, encode
from skyless.core.air.frame import Heard
from skyless.core.air.neighbours import RELAYED_TICKS, Neighbour, find_neighbour, is_confirmed, neighbour_of
from skyless.core.estimator.state import find_anchor
from skyless.core.native.library import compiled
from skyless.core.tag.hearing import wake
from skyless.core.tag.receiver import Receiver
from skyless.core.ticks import fix_time_ticks, from_seconds, to_seconds, wrap
from support.bench import ROOM, tape

pytestmark = pytest.mark.site
_wake = compiled(wake)


def free_room(rate_hz, seconds):
    return [
        one.reception
        for one in tape(replace(ROOM, schedule=replace(ROOM.schedule, mode="free", rate_hz=rate_hz)), seconds)
    ]


@pytest.mark.parametrize("jump", ["host", "counter"])
def test_the_period_of_a_slow_site_survives_a_restart(jump):
    heard = free_room(2.0, 20.0)
    half, receiver = len(heard) // 2, Receiver()
    for one in heard[:half]:
        receiver.hear(replace(one, host_s=1e9 + one.host_s))
    period_s = to_seconds(receiver.tag.period_ticks)
    assert period_s == pytest.approx(0.512)
    fixes = 0
    for one in heard[half:]:
        if jump == "host":
            later = replace(one, host_s=3e9 + one.host_s)
        else:
            later = replace(one, host_s=None, rx_ticks=wrap(one.rx_ticks - from_seconds(5.0)))
        fixes += receiver.hear(later) is not None
    assert {"impossible-host-time", "counter-jump"} & receiver.counters.keys()
    assert to_seconds(receiver.tag.period_ticks) == period_s
    assert fixes > 60


def test_an_anchor_without_a_known_place_is_not_used():
    """Its row may have gone to a stranger's, and its frames with a certificate carry no position."""
    heard, receiver = free_room(30.0, 2.0), Receiver()
    half = len(heard) // 2
    for one in heard[:half]:
        receiver.hear(one)
    beacon, t = decode(heard[half].frame), receiver.admission.neighbours
    t.rows[find_neighbour(t, beacon.anchor)] = Neighbour(anchor=60_000)
    state = receiver.method.estimator.state
    before_m = list(state.anchors[find_anchor(state, beacon.anchor)].position_m)
    bare = encode(replace(beacon, position=None, page=None))
    assert receiver.hear(replace(heard[half], frame=bare)) is None
    assert receiver.counters["no-position"] == 1
    assert list(state.anchors[find_anchor(state, beacon.anchor)].position_m) == before_m


@pytest.mark.parametrize(("strangers", "every_s", "first_s"), [(40, 0.25, 0.0), (36, 0.25, 0.5)])
def test_strangers_that_were_first_do_not_keep_the_anchors_out(strangers, every_s, first_s):
    """They state places near the site's anchors, and relay each other's frames at stamps that fit nothing."""
    heard, draw = free_room(10.0, 4.0), np.random.default_rng(2)
    begin, of_site = heard[0].rx_ticks, decode(heard[0].frame)
    events = [(one.rx_ticks, one) for one in heard if one.rx_ticks - begin > from_seconds(first_s)]
    for k in range(int(4.0 * strangers / every_s)):
        rx_ticks, anchor = begin + from_seconds(k * every_s / strangers), 1000 + k % strangers
        others = tuple(
            Heard(1000 + (k + 1 + j) % strangers, int(draw.integers(256)), int(draw.integers(2**40))) for j in range(8)
        )
        place = StatedPosition(float(anchor % 7), float(anchor % 5), 3.0, 0.02)
        issue, code, sequence = of_site.almanac_issue, of_site.period_code, k // strangers % 256
        forged = Beacon(of_site.site, anchor, sequence, wrap(rx_ticks), issue, code, place, others, 0, None)
        events.append((rx_ticks, replace(heard[0], frame=encode(forged), rx_ticks=wrap(rx_ticks))))
    receiver, last, fixes = Receiver(), -(10**9), 0
    for rx_ticks, one in sorted(events, key=lambda event: event[0]):
        if rx_ticks - last > 20_000:  # others collide
            fixes += receiver.hear(replace(one, host_s=None)) is not None
            last = rx_ticks
    assert fixes > 100


def test_a_tag_that_has_slept_begins_again_within_three_rounds():
    """Its counter begins at zero, and the time of fixes goes on with the sleep in it."""
    heard, receiver = free_room(50.0, 4.0), Receiver()
    half = len(heard) // 2
    fixes = [receiver.hear(one) for one in heard[:half]]
    _wake(receiver.tag, receiver.method.estimator.state, receiver.method.search, 0, 10.0)
    assert receiver.method.is_starting
    assert receiver.method.search.has_bounds
    for one in heard[half:]:
        later = replace(one, host_s=None, rx_ticks=wrap(one.rx_ticks - heard[half].rx_ticks))
        fixes += [receiver.hear(later)]
    assert not any(fixes[half : half + 8])
    assert all(fixes[half + 3 * 8 :])
    assert fixes[-1].time_s - fixes[half - 1].time_s == pytest.approx(12.0, abs=0.1)
    assert np.linalg.norm(fixes[-1].position_m - fixes[half - 1].position_m) < 0.1


def test_anchors_that_were_confirmed_before_a_sleep_are_so_after_it():
    heard, receiver = free_room(50.0, 2.0), Receiver()
    for one in heard:
        receiver.hear(one)
    t, now = receiver.admission.neighbours, receiver.admission.rx_ticks
    stranger = t.rows[neighbour_of(t, 60_000, now)]
    confirmed = {n.anchor for n in t.rows[: t.count] if is_confirmed(n, now)}
    assert len(confirmed) == len(ROOM.anchors)
    _wake(receiver.tag, receiver.method.estimator.state, receiver.method.search, 7, 1e-3)
    assert {n.anchor for n in t.rows[: t.count] if is_confirmed(n, 7)} == confirmed
    assert not any(is_confirmed(n, 7 + RELAYED_TICKS) for n in t.rows[: t.count])
    assert not is_confirmed(stranger, 7)
    assert not any(n.frames for n in t.rows[: t.count])


@pytest.mark.parametrize("slept_s", [1e-3, 1.0, 3600.0])
def test_the_time_of_fixes_goes_on_by_the_sleep(slept_s):
    """From one clock to the next, whatever the counter reads then."""
    heard, receiver = free_room(50.0, 2.0), Receiver()
    for one in heard:
        receiver.hear(one)
    time, now = receiver.admission.time, receiver.admission.rx_ticks
    for counter in (0, 2**40 - 1):
        before = fix_time_ticks(time, time.last_ticks_master, now)
        _wake(receiver.tag, receiver.method.estimator.state, receiver.method.search, counter, slept_s)
        assert to_seconds(fix_time_ticks(time, counter, counter) - before) == pytest.approx(slept_s, abs=1e-9)
        now = counter
