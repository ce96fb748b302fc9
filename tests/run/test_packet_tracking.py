"""``joint`` on packets of systems without a master, in a simulated hall (``masterless_world``)."""

import random
from itertools import pairwise

import numpy as np
import pytest
from msgspec import structs

from skyless.core.fix import NoFixReason
from skyless.radio.foreign.bitcraze import decode_payload
from skyless.run.masterless.packet_tracking import MASTERLESS, PacketTracking
from skyless.site.survey.anchor_errors import AnchorCalibration, DifferenceCalibration
from support import masterless_world as hall

pytestmark = pytest.mark.site

SECONDS = 6.0
SPEED_MPS = 1.0
EXACT = MASTERLESS.changed( survey_std_m=0.0, range_std_m=0.0, slope_std_m=0.0, place_std_m=0.0, change_memory_s=0.0,
    rx_variance_m2=9e-4,
)  # fmt: skip
"""As the hall is where nothing else is asked for."""


def capture(system, seed=7, **world):
    """(true time, packet) of a hall in which the tag walks."""
    options = {"told": world.pop("told", True)}
    late_m, seconds = world.pop("late_m", {}), world.pop("seconds", SECONDS)
    room = hall.MasterlessWorld(seed, **({"speed_mps": SPEED_MPS} | world))
    room.late_m = late_m
    records = hall.CAPTURES[system](room, seconds, **options)
    return room, [(t_s, decode_payload(payload, None, sender, rx_ticks)) for t_s, sender, rx_ticks, payload in records]


@pytest.fixture(scope="module", params=list(hall.CAPTURES))
def walked(request):
    """What one walk of either system sounded like."""
    return capture(request.param)


def follow(
    timed, speed_mps=SPEED_MPS, anchors_m=hall.ANCHORS_M, height_m=None, settle_s=1.0, settings=MASTERLESS, rest_s=0.0,
    **options,
):  # fmt: skip
    """The tracking at the end, rows of true time, error and time of the fix, and the normalised errors squared."""
    tracking = PacketTracking(settings.changed(height_m=height_m), anchors_m, **options)
    rows, squared = [], []
    for t_s, packet in timed:
        fix = tracking.on_packet(packet)
        if fix is not None and t_s >= settle_s:
            error_m = fix.position_m - np.array(hall.path_m(t_s, speed_mps, rest_s))
            rows.append((t_s, *error_m, fix.time_s))
            squared.append(float(error_m @ np.linalg.solve(fix.covariance_m2, error_m)) if height_m is None else 0.0)
    return tracking, np.array(rows), np.array(squared)


def rmse_m(rows, axes=3):
    return float(np.sqrt((rows[:, 1 : 1 + axes] ** 2).sum(axis=1).mean()))


def altered(timed, alter, share, seed=1):
    """Some packets, in random places, as ``alter`` makes them."""
    chance = random.Random(seed)
    return [(t_s, alter(packet, chance) if chance.random() < share else packet) for t_s, packet in timed]


def test_a_walk_is_followed_and_the_errors_are_as_said(walked):
    _, timed = walked
    tracking, rows, squared = follow(timed)
    assert len(rows) > 0.98 * sum(t_s >= 1.0 for t_s, _ in timed)
    assert rmse_m(rows, 2) < 0.03
    assert rmse_m(rows) < 0.06
    assert squared.mean() / 3 < 1.5  # less than one, as nothing is reflected in this hall
    assert rows[0, 4] == pytest.approx(rows[0, 0] - timed[0][0], abs=1e-3)
    assert np.diff(rows[:, 4]) == pytest.approx(np.diff(rows[:, 0]), abs=1e-6)
    assert sum(tracking.drops.values()) < 0.01 * len(timed)


@pytest.mark.parametrize("looks_for_rest", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_a_fault_needs_an_anchor_that_could_contradict_it(seed, looks_for_rest):
    """Four anchors in two dimensions: a tag that stands and then drives off moves, instead of an anchor's range error.

    On recorded packets one got a fault of 38 cm that it did not have, and nothing was left to contradict that.
    """
    _, timed = capture("tdoa3", seed=seed, seconds=12.0, speed_mps=0.25, rest_s=3.5)
    four = [(t_s, packet) for t_s, packet in timed if packet.anchor in {0, 2, 4, 6}]
    settings = MASTERLESS.changed(stationary_s=3.0 if looks_for_rest else 0.0)
    tracking, rows, _ = follow(four, 0.25, height_m=1.2, rest_s=3.5, settings=settings)
    assert tracking.tracking.excluded == ()
    assert len(rows) > 0.98 * sum(t_s >= 1.0 for t_s, _ in four)
    assert rmse_m(rows, 2) < 0.08


@pytest.mark.parametrize("system", hall.CAPTURES)
@pytest.mark.statistical
def test_errors_over_many_halls_are_as_said(system):
    """Tags at rest: six halls of other clocks, antenna delays and noise."""
    means = []
    for seed in range(6):
        _, timed = capture(system, seed=100 + seed, speed_mps=0.0)
        _, _, squared = follow(timed, speed_mps=0.0, settings=EXACT)
        means.append(squared.mean() / 3)
    assert 0.4 < np.mean(means) < 1.2  # calmer than assumed, with errors of antenna delays that are not


def test_the_anchors_own_antenna_delays_are_found():
    """Without them time differences are off by half of what TX and RX of two nodes differ in."""
    room, timed = capture("tdoa2", delay_scatter_ticks=60.0)
    tracking, rows, _ = follow(timed)
    _, equal, _ = follow(timed, calibration=DifferenceCalibration({}))
    halves_m = room.delays[: hall.TAG].sum(axis=1) / 2.0 * hall.SPEED_OF_LIGHT_MPS / hall.TICK_RATE_HZ
    found_m = np.array([tracking._delays.own_m[anchor] for anchor in hall.ANCHORS_M])
    assert found_m == pytest.approx(halves_m - halves_m.mean(), abs=0.05)
    assert rmse_m(rows) < 0.08 < 0.1 < rmse_m(equal)


def test_a_calibration_is_taken_off_instead():
    """Biases as ``skyless survey`` finds them: half of an anchor's TX and RX delay, and more with the range."""
    room, timed = capture("tdoa3", delay_scatter_ticks=60.0)
    halves_m = room.delays[: hall.TAG].sum(axis=1) / 2.0 * hall.SPEED_OF_LIGHT_MPS / hall.TICK_RATE_HZ
    known = {anchor: AnchorCalibration(float(halves_m[anchor] - halves_m.mean())) for anchor in hall.ANCHORS_M}
    _, rows, _ = follow(timed, calibration=DifferenceCalibration(known))
    assert rmse_m(rows) < 0.06
    sloped = {anchor: AnchorCalibration(one.bias_m, 0.2) for anchor, one in known.items()}
    _, wrong, _ = follow(timed, calibration=DifferenceCalibration(sloped))
    assert rmse_m(wrong) > 2 * rmse_m(rows)


@pytest.mark.parametrize("system", hall.CAPTURES)
def test_without_told_flights_the_anchors_range_each_other(system):
    _, timed = capture(system, told=False)
    tracking, rows, _ = follow(timed)
    assert rmse_m(rows) < 0.06
    assert 0 < tracking.drops["time-of-flight-unknown"] <= 3 * 8 * 7


@pytest.mark.parametrize("system", hall.CAPTURES)
def test_a_blocked_anchor_does_not_pull_the_tag_away(system):
    _, timed = capture(system, late_m={3: (3.0, 5.0, 0.8)})
    tracking, rows, _ = follow(timed)
    again = PacketTracking(MASTERLESS, hall.ANCHORS_M)
    assert rmse_m(rows, 2) < 0.06
    assert tracking.drops["outlier"] >= 1
    excluded = {}
    for t_s, packet in timed:
        again.on_packet(packet)
        excluded[t_s] = again.tracking.excluded
    assert {told for t_s, told in excluded.items() if 3.3 < t_s < 4.9} == {(3,)}
    assert {told for t_s, told in excluded.items() if t_s > 5.3} == {()}
    assert len(rows) > 0.98 * sum(t_s >= 1.0 for t_s, _ in timed)  # the others carry the fixes on


def wild(stamp, bits, chance):
    """A stamp that is off by 50 to 350 ns, as single ones of real captures are."""
    return (stamp + chance.choice((-1, 1)) * chance.randrange(3200, 22400)) % (1 << bits)


def test_wild_stamps_do_no_harm(walked):
    _, timed = walked

    def tx(packet, chance):
        return structs.replace(packet, tx_ticks=wild(packet.tx_ticks, 32, chance))

    def rx(packet, chance):
        return structs.replace(packet, rx_ticks=wild(packet.rx_ticks, 40, chance))

    def told(packet, chance):
        relays = [structs.replace(relay, rx_ticks=wild(relay.rx_ticks, 32, chance)) for relay in packet.relays]
        return structs.replace(packet, relays=tuple(relays))

    for alter in (tx, rx, told):
        tracking, rows, _ = follow(altered(timed, alter, 0.03))
        assert rmse_m(rows, 2) < 0.03
        assert rmse_m(rows) < 0.06
        assert tracking.drops["outlier" if alter is not told else "relay-outlier"] > 0.02 * len(timed)


def test_bit_errors_in_the_tags_stamps_do_little(walked):
    _, timed = walked

    def flipped(packet, chance):
        return structs.replace(packet, rx_ticks=packet.rx_ticks ^ (1 << chance.randrange(40)))

    tracking, rows, _ = follow(altered(timed, flipped, 0.01))
    assert rmse_m(rows, 2) < 0.06
    assert len(rows) > 0.8 * len(timed) * (SECONDS - 1.0) / SECONDS
    assert tracking.drops["impossible-stamp"] > 0


def test_lost_repeated_and_exchanged_packets(walked):
    _, timed = walked
    chance = random.Random(2)
    half = [moment for moment in timed if chance.random() < 0.5]
    _, rows, _ = follow(half)
    assert rmse_m(rows) < 0.1
    twice = [moment for moment in timed for _ in range(2)]
    tracking, rows, _ = follow(twice)
    assert tracking.drops["duplicate"] == len(timed)
    assert rmse_m(rows) < 0.06
    exchanged = list(timed)
    for k in range(10, len(timed) - 1, 20):
        exchanged[k], exchanged[k + 1] = exchanged[k + 1], exchanged[k]
    tracking, rows, _ = follow(exchanged)
    assert tracking.drops["out-of-order"] > 0.04 * len(timed)
    assert rmse_m(rows) < 0.06


def restarted(packet, by):
    relays = tuple(structs.replace(relay, rx_ticks=(relay.rx_ticks + by) % 2**32) for relay in packet.relays)
    return structs.replace(packet, tx_ticks=(packet.tx_ticks + by) % 2**32, relays=relays)


def test_an_anchor_restarts(walked):
    _, timed = walked
    again = [
        (t_s, restarted(packet, 123_456_789) if packet.anchor == 2 and t_s > 3.0 else packet) for t_s, packet in timed
    ]
    tracking, rows, _ = follow(again)
    assert (tracking.drops["impossible-stamp"], tracking.drops["clock-restarted"]) == (3, 1)
    assert rmse_m(rows) < 0.06
    assert len(rows) > 0.98 * sum(t_s >= 1.0 for t_s, _ in timed)


def test_the_tag_restarts(walked):
    _, timed = walked
    again = [
        (t_s, packet if t_s < 3.0 else structs.replace(packet, rx_ticks=(packet.rx_ticks - 5 * 10**11) % 2**40))
        for t_s, packet in timed
    ]
    tracking, rows, _ = follow(again)
    assert rmse_m(rows) < 0.06
    assert rows[-1, 0] > SECONDS - 0.1
    assert all(later > earlier for earlier, later in pairwise(rows[:, 4]))
    assert tracking.drops["out-of-order"] > 0


@pytest.mark.parametrize("jump_s", [0.07, 8.0, 50.0, 7200.0, 2e9])
def test_silences_by_the_hosts_clock(walked, jump_s):
    """The tag's 40 bits wrap every 17 s; a host whose clock is set by decades ends nothing."""
    _, timed = walked
    ticks = round(jump_s * hall.TICK_RATE_HZ) if jump_s < 1e9 else 0
    later = []
    for t_s, packet in timed:
        host_s, moved = (1e9 + t_s, packet) if t_s < 3.0 else (1e9 + t_s + jump_s, restarted(packet, ticks))
        rx_ticks = packet.rx_ticks if t_s < 3.0 else (packet.rx_ticks + ticks) % 2**40
        later.append((t_s, structs.replace(moved, host_s=host_s, rx_ticks=rx_ticks)))
    tracking, rows, _ = follow(later)
    assert rmse_m(rows) < 0.06
    assert rows[-1, 0] > SECONDS - 0.1
    assert len(rows) > 0.9 * sum(t_s >= 1.0 for t_s, _ in timed)
    if jump_s < 1e9:
        assert rows[-1, 4] == pytest.approx(rows[-1, 0] - timed[0][0] + jump_s, rel=1e-4)
    else:
        assert tracking.drops["impossible-host-time"] == 1


def test_why_there_is_no_fix(walked):
    _, timed = walked
    two = {anchor: hall.ANCHORS_M[anchor] for anchor in (0, 1)}
    tracking, rows, _ = follow([moment for moment in timed if moment[1].anchor in two], anchors_m=two, height_m=1.2)
    assert (len(rows), tracking.reason) == (0, NoFixReason.TOO_FEW_ANCHORS)
    tracking, rows, _ = follow(timed, anchors_m={})
    assert (len(rows), tracking.reason) == (0, NoFixReason.NO_ALMANAC)
    assert tracking.drops["unknown-anchor"] == len(timed)


def test_packets_that_tell_their_place_need_no_table(walked):
    _, timed = walked
    telling = [
        (t_s, structs.replace(packet, position_m=tuple(map(float, hall.ANCHORS_M[packet.anchor]))))
        for t_s, packet in timed
    ]
    _, told, _ = follow(telling, anchors_m={})
    _, surveyed, _ = follow(timed)
    assert (told == surveyed).all()


def test_random_stamps_raise_nothing(walked):
    chance = random.Random(3)

    def mangled(packet, chance):
        relays = tuple(
            structs.replace(
                relay,
                anchor=chance.randrange(300),
                rx_ticks=chance.randrange(2**32),
                tof_ticks=chance.choice((None, 1, 65535)),
            )
            for relay in packet.relays
        )
        return structs.replace(
            packet,
            host_s=chance.choice((None, chance.uniform(0.0, 4e9))),
            anchor=chance.randrange(300),
            tx_ticks=chance.randrange(2**32),
            rx_ticks=chance.randrange(2**40),
            relays=relays,
        )

    _, timed = walked
    everywhere = {anchor: (chance.uniform(0, 9), chance.uniform(0, 9), chance.uniform(0, 3)) for anchor in range(280)}
    for share in (1.0, 0.5):
        _, rows, _ = follow(altered(timed, mangled, share), anchors_m=everywhere | hall.ANCHORS_M)
        assert np.isfinite(rows).all()
