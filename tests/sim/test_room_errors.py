"""What real rooms do to ranges and crystals: against closed forms, at tags and between anchors."""

import hashlib
import math

import msgspec
import numpy as np
import pytest
from metronome import AT_REST, IDEAL, LAB, Metronome, faulty, lateness, site_of, staggered
from scipy.integrate import quad
from scipy.stats import chi2, kstest, uniform

from skyless.core.native.views import view
from skyless.core.site import WallSite
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_RATE_HZ, TICK_S, difference
from skyless.sim import impairments as faults
from skyless.sim.listening import TagSpec
from skyless.sim.oscillator import OscillatorModel, clock_rate, drift_phase_s, make_clocks, warm_up
from skyless.sim.streams import stream
from skyless.sim.trajectory import Static, Waypoints
from skyless.sim.world import World
from skyless.site.channel import ChannelModel

pytestmark = pytest.mark.site

PLACES_M = {anchor.id: np.array([anchor.x_m, anchor.y_m]) for anchor in LAB.anchors}


def _late_at_anchors_m(changed, sites=(LAB, LAB)):
    """How much later anchors stamp each other's frames than in the ideal world, by (listener, sender)."""
    heard = []
    for site, impairments in zip(sites, (IDEAL, changed), strict=True):
        machines = {}

        def make(anchor, machines=machines):
            machines[anchor] = staggered()(anchor)
            return machines[anchor]

        for _ in World(site, make, [], impairments, 7).run(0.1):
            pass
        heard.append(machines)
    late = {}
    for listener, machine in heard[0].items():
        for plain, changed_one in zip(machine.heard, heard[1][listener].heard, strict=True):
            assert plain.frame[:2] == changed_one.frame[:2]
            sender = int.from_bytes(plain.frame[:2], "little")
            late.setdefault((listener, sender), []).append(difference(changed_one.rx_ticks, plain.rx_ticks) * TICK_M)
    return late


def test_displaced_anchors_are_heard_from_where_they_truly_are():
    """By tags and by other anchors; and they themselves hear there."""
    shift = np.array([0.3, -0.2])
    changed = faulty(anchor_displacements=(faults.AnchorDisplacement(3, *shift),))
    for anchor, rows in lateness(changed, 0.2).items():
        moved = PLACES_M[anchor] + (shift if anchor == 3 else 0.0)
        longer_m = math.dist(moved, (3.0, 4.0)) - math.dist(PLACES_M[anchor], (3.0, 4.0))
        assert rows[:, 1] == pytest.approx(longer_m, abs=1.01 * TICK_M)
    for (listener, sender), late_m in _late_at_anchors_m(changed).items():
        ends = [PLACES_M[one] + (shift if one == 3 else 0.0) for one in (listener, sender)]
        longer_m = math.dist(*ends) - math.dist(PLACES_M[listener], PLACES_M[sender])
        assert late_m == pytest.approx([longer_m] * len(late_m), abs=1.01 * TICK_M)


def test_machines_are_told_the_places_of_the_site_file():
    world = World(LAB, staggered(), [], faulty(anchor_displacements=(faults.AnchorDisplacement(3, 1.0),)), 1)
    assert tuple(world.medium.stations[2].position_m) == (7.0, 4.0, 0.0)
    assert (LAB.anchors[2].x_m, LAB.anchors[2].y_m) == (6.0, 4.0)


def test_drawn_constants_are_uniform_stay_and_belong_to_their_pair():
    tags = [TagSpec(Static(2.0 + 0.01 * k, 3.0)) for k in range(120)]
    worlds = [World(LAB, staggered(), tags, i, 3) for i in (IDEAL, faulty(range_errors=faults.RangeErrorModel(0.05)))]
    late = {}
    for plain, changed in zip(*(world.run(0.1) for world in worlds), strict=True):
        late.setdefault(plain.anchor, []).append((changed.rx_ticks - plain.rx_ticks) * TICK_M)
    found = np.array([late[anchor.id][:4] for anchor in LAB.anchors])  # anchors, frames, tags
    drawn = worlds[1].medium.range_errors.present_m[6:]
    assert np.abs(found - drawn.T[:, None]).max() <= 1.01 * TICK_M
    assert kstest(drawn.ravel(), uniform(-0.05, 0.1).cdf).pvalue > 1e-4
    few = World(LAB, staggered(), tags[:3], faulty(range_errors=faults.RangeErrorModel(0.05)), 3)
    assert (few.medium.range_errors.present_m[6:] == drawn[:3]).all()
    other = World(LAB, staggered(), tags[:3], faulty(range_errors=faults.RangeErrorModel(0.05)), 4)
    assert not (other.medium.range_errors.present_m[6:] == drawn[:3]).any()
    assert not worlds[1].medium.range_errors.present_m[:6].any()


def test_the_slope_grows_with_the_distance_at_tags_alone():
    for distance_m, share in ((0.0, -1.0), (2.0, -0.5), (4.0, 0.0), (7.0, 0.75), (8.0, 1.0), (30.0, 1.0)):
        assert faults.slope_error_m(0.05, distance_m) == pytest.approx(0.05 * share)
    model = faulty(range_errors=faults.RangeErrorModel(slope_m=0.08))
    place = Static(0.5, 1.5)
    for anchor, rows in lateness(model, 0.2, tag=TagSpec(place)).items():
        expected_m = 0.08 * np.clip((math.dist(PLACES_M[anchor], (0.5, 1.5)) - 4.0) / 4.0, -1.0, 1.0)
        assert rows[:, 1] == pytest.approx(expected_m, abs=1.01 * TICK_M)
    assert {value for values in _late_at_anchors_m(model).values() for value in values} == {0.0}


def _lagged(history, lag):
    """Mean square of a process of mean 0, and its correlation at a lag, over many independent ones."""
    before, after = history[:-lag], history[lag:]
    return np.mean(history**2), np.mean(before * after) / np.mean(history**2)


@pytest.mark.parametrize("along", ["time", "way"])
@pytest.mark.statistical
def test_changing_errors_forget_with_their_correlation_length(along):
    """300 tags that walk at 0.5 m/s: 10 s are 5 m. Tags at rest forget with the time alone."""
    paths = [Waypoints([(0, k), (500, k)], 0.5) for k in range(300)] + [Static(0.0, 0.0)]
    length = {"correlation_s": 10.0} if along == "time" else {"correlation_m": 5.0}
    world = World(site_of((0, 0), (1, 0)), staggered(), [TagSpec(p) for p in paths], IDEAL, 5)
    errors = faults.RangeErrors(faults.RangeErrorModel(changing_m=0.029, **length), len(paths), 2, 5)
    history = []
    for step in range(301):
        world.medium._move_tags(0.5 * step)
        errors.advance_to(0.5 * step, view(world.medium.stations))
        history.append(errors.present_m[2:].copy())
    walking, resting = np.array(history)[:, :-1], np.array(history)[:, -1]
    assert (np.ptp(resting, axis=0) == 0.0).all() == (along == "way")
    spread, correlation = _lagged(walking, 20)
    effective = 600 * 150.0 / 20.0  # processes of 15 correlation lengths, two of which are about one sample
    low, high = chi2.ppf([1e-4, 1 - 1e-4], effective) / effective
    assert 0.98 * low < spread / 0.029**2 < high
    assert correlation == pytest.approx(math.exp(-1.0), abs=4.0 / math.sqrt(effective))
    assert _lagged(walking, 1)[1] == pytest.approx(math.exp(-0.05), abs=0.01)
    assert np.abs(np.diff(walking, axis=0)).max() < 0.029 * 5.0 * math.sqrt(2.0 * 0.05)


def test_changing_errors_reach_the_stamps():
    model = faulty(range_errors=faults.RangeErrorModel(changing_m=0.1, correlation_s=0.2))
    world = World(LAB, staggered(), [AT_REST], model, 7)
    plain = World(LAB, staggered(), [AT_REST], IDEAL, 7)
    seen = set()
    for clear in plain.run(2.0):
        changed = next(world.run(clear.end_s + 1e-4))  # its errors are those of its own emission until the next one
        late_m = difference(int(changed.rx_ticks[0]), int(clear.rx_ticks[0])) * TICK_M
        assert late_m == pytest.approx(world.medium.range_errors.present_m[6, clear.anchor - 1], abs=1.01 * TICK_M)
        seen.add(round(late_m, 2))
    assert len(seen) > 10


def _crosses(a, b, wall):
    """Whether two segments cross, by the parameters of their intersection."""
    c, d = np.array([wall.x1_m, wall.y1_m]), np.array([wall.x2_m, wall.y2_m])
    along = np.linalg.solve(np.column_stack([b - a, c - d]), c - a)
    return bool(((along > 0.0) & (along < 1.0)).all())


@pytest.mark.parametrize("between_anchors", [False, True])
def test_a_wall_delays_while_it_stands_between(between_anchors):
    """A tag that walks past at 1 m/s; anchors 2 and 6 do not see each other, which counts only if asked."""
    wall = WallSite(4.2, 2.6, 4.3, 4.6, delay_m=0.25)
    walled = msgspec.structs.replace(LAB, walls=(wall,))
    path = Waypoints([(3.0, 1.0), (3.0, 7.0)], 1.0)
    changed = faulty(channel=ChannelModel(walls_between_anchors=between_anchors))
    late = lateness(changed, 6.0, tag=TagSpec(path), sites=(LAB, walled))
    behind_s = {}
    for anchor, rows in late.items():
        blocked = np.array([_crosses(path.position(t)[:2], PLACES_M[anchor], wall) for t in rows[:, 0]])
        assert rows[:, 1] == pytest.approx(np.where(blocked, 0.25, 0.0), abs=1.01 * TICK_M)
        behind_s[anchor] = 0.015 * blocked.sum()
    assert behind_s[3] == pytest.approx(3.4, abs=0.2)  # two metres, seen from anchor 3, are that long on the tag's line
    assert behind_s[1] == behind_s[5] == behind_s[6] == 0.0
    for (listener, sender), late_m in _late_at_anchors_m(changed, (LAB, walled)).items():
        blocked = between_anchors and _crosses(PLACES_M[listener], PLACES_M[sender], wall)
        assert late_m == pytest.approx([0.25 if blocked else 0.0] * len(late_m), abs=1.01 * TICK_M)


def test_a_body_shadows_its_sector_behind_the_tag_and_turns_with_it():
    body = faults.Body(delay_m=0.2, sector_rad=math.radians(100.0))
    path = Waypoints([(2.0, 3.0), (4.0, 3.0), (4.0, 5.0)], 1.0)
    late = lateness(faulty(body=body), 4.0, tag=TagSpec(path))
    shadowed = 0
    for anchor, rows in late.items():
        for t_s, late_m in rows:
            towards, heading = PLACES_M[anchor] - path.position(t_s)[:2], path.velocity(t_s)[:2]
            turned = math.atan2(*towards[::-1]) - math.atan2(*heading[::-1]) - math.pi
            off = abs(math.degrees(math.remainder(turned, 2.0 * math.pi)))
            assert late_m == pytest.approx(0.2 if off <= 50.0 else 0.0, abs=1.01 * TICK_M)
            shadowed += off <= 50.0
    assert 0.2 < shadowed / sum(map(len, late.values())) < 0.5
    assert {value for values in _late_at_anchors_m(faulty(body=body)).values() for value in values} == {0.0}


def test_a_body_in_front_of_a_tag_at_rest_looks_along_x():
    late = lateness(faulty(body=faults.Body(0.2, math.radians(20.0), 0.0)), 0.2)
    assert {anchor for anchor, rows in late.items() if rows[:, 1].mean() > 0.1} == {3}  # at (6, 4), seen from (3, 4)


def test_a_bias_lasts_from_one_time_to_another():
    """Within it bursts come and go as always; without times it lasts from beginning to end."""
    biases = (
        faults.AnchorBias(2, 0.3, from_s=0.5, to_s=1.25),
        faults.AnchorBias(4, 1.0, 0.2, 0.3, from_s=1.0),
        faults.AnchorBias(6, 0.5),
    )
    late = lateness(faulty(anchor_biases=biases), 2.0)
    assert late[6][:, 1] == pytest.approx(0.5, abs=1.01 * TICK_M)
    assert not np.vstack([late[anchor] for anchor in (1, 3, 5)])[:, 1].any()
    t_s, late_m = late[2].T
    assert late_m == pytest.approx(np.where((t_s >= 0.5) & (t_s < 1.25), 0.3, 0.0), abs=1.01 * TICK_M)
    t_s, late_m = late[4].T
    assert late_m == pytest.approx(np.where((t_s >= 1.0) & (t_s % 0.5 >= 0.3), 1.0, 0.0), abs=1.01 * TICK_M)


def test_a_bias_that_creeps_grows_from_its_beginning_and_ends_at_once():
    late = lateness(faulty(anchor_biases=(faults.AnchorBias(2, 0.1, from_s=0.5, to_s=1.5, creep_mps=0.4),)), 2.0)
    t_s, late_m = late[2].T
    grown_m = np.where((t_s >= 0.5) & (t_s < 1.5), 0.1 + 0.4 * (t_s - 0.5), 0.0)
    assert late_m == pytest.approx(grown_m, abs=1.01 * TICK_M)


@pytest.mark.parametrize("ppm", [1.0, -1.0, 5.0])
@pytest.mark.statistical
def test_a_warming_crystal_gains_what_its_curve_says(ppm):
    """The tag's stamps run ahead by ppm·(t − τ(1 − e^(−t/τ))), t from the start of the warm-up."""
    rows = np.vstack(list(lateness(faulty(warm_ups=(faults.WarmUp(ppm, 20.0, 1.0),)), 10.0).values()))
    since_s = np.maximum(rows[:, 0] - 1.0, 0.0)
    ahead_s = ppm * 1e-6 * (since_s - 20.0 * (1.0 - np.exp(-since_s / 20.0)))
    assert rows[:, 1] == pytest.approx(ahead_s * SPEED_OF_LIGHT_MPS, abs=1.01 * TICK_M + 1e-5)
    assert np.abs(rows[:, 1]).max() > 400.0 * abs(ppm)


def test_the_phase_of_a_warm_up_is_the_integral_of_its_rate():
    clocks = make_clocks(OscillatorModel(offset_ppm=0.0), [stream(1, 0, 0, 1)])
    warm_up(clocks[0], -2.0, 5.0, 20.0)

    def rate(t_s):
        clocks[0].true_ticks = round(t_s * TICK_RATE_HZ)
        return clock_rate(clocks[0])

    assert (rate(4.9), rate(5.0)) == (0.0, 0.0)
    assert rate(25.0) == pytest.approx(-2e-6 * (1.0 - math.exp(-1.0)))
    for from_s, to_s in ((0.0, 4.0), (4.0, 6.0), (7.0, 100.0), (30.0, 30.0025)):
        integral, _ = quad(rate, from_s, to_s, epsabs=1e-18, limit=200, points=[min(max(5.0, from_s), to_s)])
        assert drift_phase_s(clocks[0], from_s, to_s) == pytest.approx(integral, rel=1e-6, abs=1e-18)


def test_an_anchors_crystal_warms_alone():
    """It speaks too early, as its counter runs ahead; the others speak as before."""
    changed = faulty(warm_ups=(faults.WarmUp(2.0, 20.0, anchor=3),))
    worlds = [World(LAB, staggered(), [AT_REST], impairments, 7) for impairments in (IDEAL, changed)]
    for plain, warm in zip(*(world.run(2.0) for world in worlds), strict=True):
        t_s = plain.emission_s
        ahead_s = 2e-6 * (t_s - 20.0 * (1.0 - math.exp(-t_s / 20.0))) if plain.anchor == 3 else 0.0
        assert plain.emission_s - warm.emission_s == pytest.approx(ahead_s, abs=1.01 * TICK_S)


def test_the_lab_is_what_it_was():
    """Its ticks, whatever anchors send, as at commit 12610a1, before worlds knew of the errors of rooms."""
    tags = [AT_REST, TagSpec(Waypoints([(1, 1), (5, 1), (5, 7)], 1.0))]
    digest = hashlib.sha256()
    for broadcast in World(LAB, staggered(), tags, faults.lab_impairments(100.0), 1).run(0.5):
        digest.update(broadcast.frame + broadcast.rx_ticks.tobytes())
    assert digest.hexdigest() == "acd622382a8ffca57eefffb93c2fe663f1b0244226aeac5dedfb5626a2c2bc89"


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: faults.RangeErrorModel(changing_m=0.03), "either correlation_s or correlation_m"),
        (lambda: faults.RangeErrorModel(correlation_s=1.0, correlation_m=1.0), "either correlation_s or correlation_m"),
        (lambda: faults.RangeErrorModel(changing_m=0.03, correlation_m=0.0), "more than 0"),
        (
            lambda: World(LAB, Metronome, [], faulty(warm_ups=(faults.WarmUp(1.0, 1.0, anchor=9),)), 1),
            "warm_ups names anchor 9",
        ),
        (
            lambda: World(LAB, Metronome, [], faulty(anchor_displacements=(faults.AnchorDisplacement(9),)), 1),
            "anchor_displacements names anchor 9",
        ),
    ],
)
def test_mistakes_are_told(make, said):
    with pytest.raises(ValueError, match=said):
        make()
