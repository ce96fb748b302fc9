"""The master's role changes hands: time goes on, tags ride through, and a living master keeps it."""

import itertools
from fractions import Fraction

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.core.any_receiver import AnyReceiver
from skyless.core.method_names import FILTERS
from skyless.core.native.views import view
from skyless.core.protocol1.anchor import Anchor, Role
from skyless.core.protocol1.beacon import decode
from skyless.core.protocol1.clock import MAX_CHANCE, MasterWatch, SiteTime, is_newer
from skyless.core.ticks import TICK_S, Unwrapper
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.impairments import AnchorOutage, Outage
from support.bench import EVERY_METHOD, LAB, SNAPSHOTS, Stage, assert_honest

pytestmark = pytest.mark.site

SUPERFRAME_S = 15e-3
CENTRE, WALL = (3.0, 4.0, 0.0), (1.2, 1.6, 0.0)


def off(*outages):
    """(anchor, off, on) as the world takes them."""
    return tuple(AnchorOutage(anchor, Outage(*times)) for anchor, *times in outages)


def lossy(probability):
    channel = impairments_of(Request(LAB), LAB).channel
    return channel.changed(loss_probability=probability)


class Walled(Anchor):
    """An anchor that, while ``blocked`` says so, does not hear another."""

    blocked = staticmethod(lambda sender, listener, time_s: False)

    def hear(self, reception):
        beacon = decode(reception.frame)
        if not self.blocked(beacon.anchor, self.id, reception.host_s):
            super().hear(reception)


def walled(rule):
    return type("WalledBy", (Walled,), {"blocked": staticmethod(rule)})


class Story:
    """What happened on the air: every beacon with its true time, and every fix beside the truth."""

    def __init__(self, until_s, seed=1, tags=(CENTRE,), method="joint", stage=None, **how):
        self.until_s, self.stage = until_s, stage or Stage(LAB, seed, tags, **how)
        self.receivers = [AnyReceiver(method) for _ in tags]
        self.beacons, self.fixes = [], [[] for _ in tags]
        for broadcast in self.stage.world.run(until_s):
            true_s = (broadcast.emission_ticks + broadcast.emission_fraction) * TICK_S
            beacon = decode(broadcast.frame)
            self.beacons.append((true_s, broadcast.emission_ticks, broadcast.emission_fraction, beacon))
            for tag, reception, truth_m in broadcast.receptions():
                fix = self.receivers[tag].hear(reception)
                if fix is not None:
                    self.fixes[tag].append((true_s, fix, truth_m))

    def reigns(self):
        """(term, master) and the true time of its first beacon, in order of time."""
        first = {}
        for true_s, _, _, beacon in self.beacons:
            if beacon.anchor == beacon.master:
                first.setdefault((beacon.term, beacon.master), true_s)
        return [(*claim, true_s) for claim, true_s in first.items()]

    def times_of(self, anchor):
        return np.array([true_s for true_s, *_, beacon in self.beacons if beacon.anchor == anchor])

    def site_time(self):
        """True times and site time less true time in seconds, by the masters' beacons, with their terms."""
        unwrapper, rows, origin = Unwrapper(bits=48), [], None
        for true_s, ticks, fraction, beacon in self.beacons:
            if beacon.anchor == beacon.master:
                site = unwrapper.unwrap(beacon.master_time.tx_subticks_master, true_s / 256.0)
                origin = origin or (ticks, site)
                ahead = (site - origin[1] - 256 * (ticks - origin[0])) / 256.0 - fraction
                rows.append((true_s, ahead * TICK_S, beacon.term))
        return np.array(rows)

    def jumps(self):
        """Of the site's time at each takeover: s, and change of rate; lines through 0.3 s before and after it."""
        true_s, ahead_s, term = self.site_time().T
        for before, after in itertools.pairwise(sorted(set(term))):
            at = true_s[term == after][0]
            old = (term == before) & (true_s > true_s[term == before][-1] - 0.3)
            new = (term == after) & (true_s < at + 0.3)
            (old_rate, old_s), (new_rate, new_s) = (np.polyfit(true_s[m] - at, ahead_s[m], 1) for m in (old, new))
            yield new_s - old_s, new_rate - old_rate

    def assert_tags_ride_through(self, from_s=1.0, longest_gap_s=0.05, sigmas=6.0):
        for fixes in self.fixes:
            times = np.array([true_s for true_s, _, _ in fixes if true_s >= from_s])
            assert times[0] < from_s + longest_gap_s
            assert times[-1] > self.until_s - longest_gap_s
            assert np.diff(times).max() < longest_gap_s
            for true_s, fix, truth_m in fixes:
                if true_s >= from_s:
                    assert_honest(fix, truth_m, sigmas, bias_m=0.0)
            assert np.all(np.diff([fix.time_s for _, fix, _ in fixes]) > 0.0)


def quiet(stage):
    """Without the noise of emissions, which is not the site time's."""
    view(stage.world.medium.stations)["tx_noise_ticks"][:] = 0.0
    return stage


# The master's death


@pytest.mark.parametrize("off_s", [2.0, 2.004, 2.0105])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_next_one_takes_over_within_three_superframes(off_s, seed):
    """Three of the master's beacons must be missed; then comes the successor's slot."""
    story = Story(4.0, seed, (CENTRE, WALL), anchor_outages=off((1, off_s)))
    (*_, started_s), (term, master, taken_s) = story.reigns()
    assert (term, master) == (1, 2)
    assert started_s < 5 * SUPERFRAME_S
    assert taken_s - off_s < 3 * SUPERFRAME_S + SUPERFRAME_S / 6
    for anchor in (3, 4, 5, 6):
        assert np.diff(story.times_of(anchor)).max() < 1.01 * SUPERFRAME_S
    for machine in story.stage.machines.values():
        assert machine.counters["takeover"] == (machine.id == 2)
        assert machine.counters["clock-restart"] == 0
    assert [m.clock(None).role for m in story.stage.machines.values()][1:] == [Role.MASTER] + [Role.FOLLOWER] * 4
    story.assert_tags_ride_through(longest_gap_s=SUPERFRAME_S)
    assert set(story.fixes[0][-1][1].anchors) == {2, 3, 4, 5, 6}


@pytest.mark.parametrize("seed", range(4))
def test_three_deaths_in_a_row_and_time_goes_on(seed):
    """The new master's clock is known to a few centimetres and 1 ppb when it takes over.

    The old master returns as an ordinary anchor each time, and is in use again.
    """
    outages = off((1, 2.0, 3.0), (2, 4.0, 5.0), (1, 6.0, 7.0))
    story = Story(8.5, stage=quiet(Stage(LAB, seed, (CENTRE,), anchor_outages=outages)))
    assert [reign[:2] for reign in story.reigns()] == [(0, 1), (1, 2), (2, 1), (3, 2)]
    jumps = list(story.jumps())
    assert len(jumps) == 3
    for jump_s, rate_change in jumps:
        assert abs(jump_s) < 1e-9
        assert abs(rate_change) < 0.05e-6
    # The whole of it stays on the first master's scale, but for a random walk of rates.
    true_s, ahead_s, _ = story.site_time().T
    assert abs(np.polyfit(true_s, ahead_s, 1)[0] - np.polyfit(true_s[:100], ahead_s[:100], 1)[0]) < 0.05e-6
    for anchor, back_s in ((1, 3.0), (2, 5.0), (1, 7.0)):
        times = story.times_of(anchor)
        assert 0.0 < times[times > back_s].min() - back_s < 6 * SUPERFRAME_S
    story.assert_tags_ride_through(longest_gap_s=SUPERFRAME_S)
    assert set(story.fixes[0][-1][1].anchors) == {1, 2, 3, 4, 5, 6}
    assert all(m.clock(None).offset_std_m < 0.05 for m in story.stage.machines.values())
    numbers = [beacon.superframe for *_, beacon in story.beacons]
    assert np.all(np.diff(numbers) >= 0)
    assert np.diff(numbers).max() == 1


def test_master_and_successor_die_at_once():
    story = Story(4.0, 3, anchor_outages=off((1, 2.0), (2, 2.0)))
    (_, (term, master, taken_s)) = story.reigns()
    assert (term, master) == (1, 3)
    assert taken_s - 2.0 < 4 * SUPERFRAME_S + 2 * SUPERFRAME_S / 6
    story.assert_tags_ride_through(longest_gap_s=SUPERFRAME_S)
    assert set(story.fixes[0][-1][1].anchors) == {3, 4, 5, 6}


@pytest.mark.parametrize("method", SNAPSHOTS)
def test_snapshot_methods_turn_to_the_new_master(method):
    """They need two rounds of its beacons; the old master's return costs nothing."""
    story = Story(5.0, 3, method=method, anchor_outages=off((1, 2.0, 3.0)))
    story.assert_tags_ride_through(longest_gap_s=10 * SUPERFRAME_S)
    last = story.fixes[0][-1][1]
    assert last.anchors[0] == 2
    assert len(last.anchors) == 6
    assert len([1 for true_s, *_ in story.fixes[0] if true_s > 3.5]) > 0.95 * 1.5 / SUPERFRAME_S


@pytest.mark.statistical
def test_fixes_stay_as_honest_as_they_say():
    """Mean squared error in units of the fixes' own covariance, for x and y; from the death on to half a second after.

    24 runs of two tags; errors last about a tenth of a second and anchors' clocks are common to both tags, so they
    count for 24·5 independent pairs: the mean of the square over two axes has one sigma √(1/120) = 0.09.
    """
    squares = {"before": [], "through": [], "after": []}
    for seed in range(24):
        story = Story(3.2, 100 + seed, (CENTRE, WALL), anchor_outages=off((1, 2.0)))
        for true_s, fix, truth_m in itertools.chain(*story.fixes):
            if true_s > 1.4:
                part = "before" if true_s < 2.0 else "through" if true_s < 2.5 else "after"
                error_m = (fix.position_m - truth_m)[:2]
                squares[part].append(error_m @ np.linalg.solve(fix.covariance_m2[:2, :2], error_m) / 2.0)
    means = {part: float(np.mean(values)) for part, values in squares.items()}
    assert all(0.5 < mean < 1.0 + 4 * 0.09 for mean in means.values())


# Living masters keep their role


def chance_of_silence(turns, loss, others):
    """Chance that so many turns of a living master bring no news, by its own beacons or by others that relay it.

    Another anchor hears turn j first, with chance loss^(j-1)·(1 - loss), and its turns - j + 1 beacons after that are
    all lost; or it hears none.
    """
    return loss**turns * (loss**turns * (1.0 + turns * (1.0 - loss))) ** others


def watched(loss, others, turns, seed=1):
    """A watch fed with the beacons of a living master and of those that relay it, by turn."""
    generator, watch, last = np.random.default_rng(seed), MasterWatch(), [None] * others
    watch.begin(0)
    for turn in range(turns):
        if generator.random() > loss:
            watch.update(1, turn % 256, turn)
        for other in range(others):
            if generator.random() > loss:
                last[other] = turn
            if generator.random() > loss and last[other] is not None:
                watch.update(2 + other, last[other] % 256, turn)
        yield watch


@pytest.mark.parametrize("loss", [0.0, 0.05, 0.1, 0.2, 0.5, 0.7])
@pytest.mark.parametrize("others", [1, 4, 6])
def test_a_living_master_is_believed_dead_next_to_never(loss, others):
    """The chance, averaged over what the watch has learnt, times 68 superframes a second: less than once a year."""
    chances, turns_needed = [], []
    for turn, watch in enumerate(watched(loss, others, 4000)):
        if turn > 20:
            needed = next(turns for turns in range(3, 1000) if watch.is_dead(turns))
            turns_needed.append(needed)
            chances.append(chance_of_silence(needed, loss, others))
    assert np.mean(chances) < 3 * MAX_CHANCE
    if loss <= 0.1 and others >= 4:
        assert np.median(turns_needed) == 3
    if loss == 0.5 and others >= 4:
        assert 6 < np.median(turns_needed) < 12


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.statistical
def test_half_of_all_frames_lost_for_minutes(seed):
    story = Story(100.0, seed, (), channel=lossy(0.5))
    assert [reign[:2] for reign in story.reigns()] == [(0, 1)]
    assert len(story.beacons) > 0.99 * 6 * 100.0 / SUPERFRAME_S * 0.98


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_death_with_half_of_all_frames_lost(seed):
    """Noticed after some ten superframes, and tags, which lose as much, still ride through."""
    story = Story(9.0, seed, channel=lossy(0.5), anchor_outages=off((1, 5.0, 7.0)))
    reigns = story.reigns()
    assert reigns[0][:2] == (0, 1)
    assert 5.0 < reigns[1][2] < 5.0 + 30 * SUPERFRAME_S
    final = {m.clock(None).master for m in story.stage.machines.values()}
    assert len(final) == 1
    story.assert_tags_ride_through(from_s=3.0, longest_gap_s=0.2)


def test_a_deaf_anchor_deposes_nobody_at_once():
    """It hears nothing for 0.3 s: that is no news of the master's death."""
    rule = walled(lambda sender, listener, time_s: listener == 2 and 2.0 < time_s < 2.3)
    story = Story(3.0, tags=(), make=rule)
    assert [reign[:2] for reign in story.reigns()] == [(0, 1)]


def test_an_anchor_that_does_not_hear_the_master_deposes_nobody():
    """Others tell it that the master lives."""
    rule = walled(lambda sender, listener, time_s: (sender, listener) == (1, 2) and time_s > 2.0)
    story = Story(6.0, tags=(), make=rule)
    assert [reign[:2] for reign in story.reigns()] == [(0, 1)]
    assert 2.5 < story.times_of(2).max() < 3.3


# Starting, and starting again


def test_the_next_one_starts_the_site_when_the_first_does_not_come():
    """And the configured master, once there, joins as an ordinary anchor."""
    story = Story(4.0, 2, anchor_outages=off((1, 0.0, 2.0)))
    ((term, master, started_s),) = story.reigns()
    assert (term, master) == (0, 2)
    assert 0.5 < started_s < 0.53
    assert 2.0 < story.times_of(1).min() < 2.0 + 6 * SUPERFRAME_S
    assert story.stage.machines[1].clock(None).role is Role.FOLLOWER
    story.assert_tags_ride_through(from_s=1.0)
    assert len(story.fixes[0][-1][1].anchors) == 6


def test_when_the_first_two_do_not_come():
    story = Story(1.5, 2, tags=(), anchor_outages=off((1, 0.0), (2, 0.0)))
    ((term, master, started_s),) = story.reigns()
    assert (term, master) == (0, 3)
    assert 0.75 < started_s < 0.78


@pytest.mark.parametrize("method", EVERY_METHOD)
def test_the_whole_site_restarts(method):
    """Terms count from 0 again and time begins anew: tags come back within a second, and rightly."""
    outages = off((1, 1.0, 1.5), *((anchor, 3.0, 3.2) for anchor in range(1, 7)))
    story = Story(5.5, 2, method=method, anchor_outages=outages)
    assert [beacon.term for *_, beacon in story.beacons if beacon.anchor == 2][-1] == 0
    assert {beacon.term for true_s, *_, beacon in story.beacons if 2.0 < true_s < 3.0} == {1}
    late = [true_s for true_s, *_ in story.fixes[0] if true_s > 3.2]
    assert late[0] < 3.2 + 1.0
    assert len(late) > 60
    for _, fix, truth_m in story.fixes[0]:
        assert_honest(fix, truth_m)


def test_two_anchors():
    """One alone does not depose a master that it merely does not hear, but in the end carries the site's time on."""
    pair = replace(LAB, anchors=LAB.anchors[:2])
    story = Story(6.0, tags=(), stage=quiet(Stage(pair, 1, anchor_outages=off((1, 2.0, 4.0)))))
    assert [reign[:2] for reign in story.reigns()] == [(0, 1), (1, 2)]
    assert 2.5 < story.reigns()[1][2] < 2.6
    assert story.times_of(1).max() > 5.9
    ((jump_s, rate_change),) = story.jumps()
    assert abs(jump_s) < 2e-9
    assert abs(rate_change) < 0.05e-6


# Two masters


@pytest.mark.parametrize("method", EVERY_METHOD[-2:])
def test_a_parted_site_comes_together_by_term(method):
    """Anchors 1 to 3 and 4 to 6 do not hear each other for 3 s: each part has its master, and the newer term wins."""
    rule = walled(lambda sender, listener, time_s: (sender < 4) != (listener < 4) and 2.0 < time_s < 5.0)
    story = Story(7.0, method=method, make=rule)
    assert [reign[:2] for reign in story.reigns()] == [(0, 1), (1, 4)]
    last = [beacon for true_s, *_, beacon in story.beacons if beacon.master == 1][-1]
    assert next(true_s for true_s, *_, beacon in story.beacons if beacon == last) < 5.0 + 4 * SUPERFRAME_S
    for machine in story.stage.machines.values():
        state = machine.clock(None)
        assert (state.master, state.term) == (4, 1)
        assert state.role is (Role.MASTER if machine.id == 4 else Role.FOLLOWER)
        assert state.offset_std_m < 0.05
    assert method in FILTERS or story.receivers[0].counters["stale-master"] > 100
    story.assert_tags_ride_through()
    assert len(story.fixes[0][-1][1].anchors) == 6


def test_two_that_take_over_at_once_are_told_apart_by_their_order():
    """Anchors 2 and 3 do not hear each other around the master's death, so both believe to be the next."""
    rule = walled(lambda sender, listener, time_s: {sender, listener} == {2, 3} and 1.9 < time_s < 2.2)
    story = Story(4.0, make=rule, anchor_outages=off((1, 2.0)))
    assert [reign[:2] for reign in story.reigns()] == [(0, 1), (1, 2), (1, 3)]
    assert {m.clock(None).master for m in story.stage.machines.values() if m.id != 1} == {2}
    assert [true_s for true_s, *_, beacon in story.beacons if beacon.master == 3][-1] < 2.2
    story.assert_tags_ride_through()


@pytest.mark.parametrize("frozen_s", [0.1, 0.5, 2.0])
def test_a_master_whose_host_stood_still(frozen_s):
    """It listens before it speaks again, finds a newer term, and follows."""

    class Frozen(Anchor):
        def frozen(self):
            return self.id == 1 and 2.0 < stage.world.now_s < 2.0 + frozen_s

        def hear(self, reception):
            if not self.frozen():
                super().hear(reception)

        def next_transmission_ticks(self, now_ticks):
            return None if self.frozen() else super().next_transmission_ticks(now_ticks)

    stage = Stage(LAB, 1, (CENTRE,), make=Frozen)
    story = Story(4.0 + frozen_s, stage=stage)
    assert [reign[:2] for reign in story.reigns()] == [(0, 1), (1, 2)]
    woken = [beacon for true_s, *_, beacon in story.beacons if beacon.anchor == 1 and true_s > 2.0 + frozen_s]
    assert {(beacon.term, beacon.master) for beacon in woken} == {(1, 2)}
    story.assert_tags_ride_through()
    assert len(story.fixes[0][-1][1].anchors) == 6


@pytest.mark.parametrize("method", EVERY_METHOD[-2:])
def test_a_stale_master_is_not_believed(method):
    """A master that hears nobody goes on in its old term: all others, and tags with snapshots, ignore its beacons."""
    rule = walled(
        lambda sender, listener, time_s: 2.0 < time_s < 4.0 and (listener == 1 or (sender == 1 and time_s < 2.2))
    )
    story = Story(6.0, method=method, make=rule)
    assert [reign[:2] for reign in story.reigns()] == [(0, 1), (1, 2)]
    assert all(story.stage.machines[anchor].counters["stale-master"] > 50 for anchor in range(2, 7))
    assert story.stage.machines[1].clock(None).master == 2
    if method in FILTERS:
        story.assert_tags_ride_through()
    else:
        assert story.receivers[0].counters["stale-master"] > 50


# Terms


def test_terms_are_compared_as_serial_numbers():
    assert is_newer(1, 0)
    assert is_newer(0, 255)
    assert is_newer(126, 255)
    assert not is_newer(0, 0)
    assert not is_newer(255, 0)
    for one, other in itertools.product(range(256), repeat=2):
        assert not (is_newer(one, other) and is_newer(other, one))


def test_a_takeover_past_term_255():
    """The site lives in term 255 when its master dies."""
    stage = Stage(LAB, 1, (CENTRE,), anchor_outages=off((1, 2.0, 3.0)))
    for _ in stage.world.run(0.05):
        pass
    machine = stage.machines[1]
    machine._election.master_term = replace(machine._election.master_term, term=255)
    story = Story(4.0, stage=stage)
    assert [reign[:2] for reign in story.reigns()] == [(255, 1), (0, 2)]
    assert {m.clock(None).term for m in stage.machines.values()} == {0}
    story.assert_tags_ride_through()


def test_site_time_is_carried_on_for_a_year_without_loss():
    """In integers: a thousandth of a tick after a year, where float64 alone would lose a hundred ticks."""
    rate, year = 12.3456789e-6, round(3.15e7 / TICK_S)
    led = SiteTime.onwards(10**15 + 7, 3 * 10**14 + 1, 0.25, rate)
    exact = (3 * 10**14 + 1 + Fraction(1, 4) + Fraction(year) / (1 + Fraction(rate))) * 256
    told = led.subticks(10**15 + 7 + year)
    assert abs(told - exact) < 256 * year * 2e-16
    assert abs(led.ticks_own(told // 256) - (10**15 + 7 + year)) <= 1
    assert led.rate == pytest.approx(rate, rel=1e-9)
