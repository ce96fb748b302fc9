"""Phases of the carrier: what they must not depend on, what they must not harm, and what they buy."""

from functools import partial
from itertools import permutations

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.core.any_receiver import AnyReceiver
from skyless.core.ticks import TICK_M
from skyless.research.studies.runner import Plan
from skyless.research.studies.worlds import Heard, Run, beacons_of, box, run_world, worlds
from skyless.sim.evaluation.scenarios import Request, Room, impairments_of, trajectories_of, wanderer
from skyless.sim.impairments import Body, CarrierModel, RangeErrorModel
from skyless.sim.lab import lab_site

SITE = lab_site()
USUAL = CarrierModel()


def heard(seed, seconds=4.0, tags=1, carrier=USUAL, site=SITE, room=Room()):  # noqa: B008 - frozen
    """What tags of a room receive."""
    request = Request(site, seed=seed, tags=tags, room=room)
    impairments = replace(impairments_of(request, site), carrier=carrier)
    paths = tuple(trajectories_of(request))
    return list(beacons_of(Run(site, paths, impairments, seed, "joint", 0.0, seconds)))


def plain(rate_hz, *, relays_phases=True):
    """The lab with plain crystals and beacons at this rate of each anchor."""
    schedule = replace(SITE.schedule, rate_hz=rate_hz, carrier_phase=relays_phases)
    return replace(SITE, noise=replace(SITE.noise, random_walk_fm=5e-9), schedule=schedule)


@pytest.fixture(scope="module")
def beacons():
    return heard(3, 6.0)


def with_phases(beacons: list[Heard], change):
    """The receptions of the first tag, with other phases."""
    return [
        (replace(reception, carrier_phase_cycles=change(beacon, reception)), truth_m)
        for beacon in beacons
        for tag, reception, truth_m in beacon.receptions
        if tag == 0
    ]


def fixes_of(receptions, receiver=None):
    """Positions after each reception, NaN without a fix, and the state at the end."""
    receiver = receiver or AnyReceiver()
    fixes = [receiver.hear(reception) for reception, _ in receptions]
    positions = [np.full(2, np.nan) if fix is None else fix.position_m[:2] for fix in fixes]
    return np.array(positions), receiver.receiver.method.estimator.state


def test_constants_of_the_radios_do_not_matter(beacons):
    """Any constant may be in the phases of an anchor: a fraction of a cycle that is not known."""
    as_they_are, state = fixes_of(with_phases(beacons, lambda _, one: one.carrier_phase_cycles))
    shifts = np.random.default_rng(1).random(256)
    shifted, _ = fixes_of(
        with_phases(beacons, lambda _, one: float((one.carrier_phase_cycles + shifts[one.frame[9]]) % 1.0))
    )
    assert state.status.phases_used > 300
    assert np.nanmax(np.abs(shifted - as_they_are)) < 1e-6


def test_noise_instead_of_phases_does_no_harm(beacons):
    """Phases that have nothing to do with the receptions are opened and refused, and stamps decide."""
    draw = np.random.default_rng(2)
    truths = [truth_m for _, truth_m in with_phases(beacons, lambda _, one: None)]
    stamps, _ = fixes_of(with_phases(beacons, lambda _, one: None))
    noise, state = fixes_of(with_phases(beacons, lambda _, one: float(draw.random())))
    truth = np.array(truths)[:, :2]
    rmse_m = [np.sqrt(np.nanmean(np.sum((found - truth) ** 2, axis=1))) for found in (stamps, noise)]
    assert state.status.phases_opened > 5 * state.status.phases_used
    assert rmse_m[1] < 1.3 * rmse_m[0]


def test_a_reset_of_a_radio_is_found(beacons):
    """All phases of an anchor change at once: its ambiguity begins again; fixes move by less than without phases."""
    half = len(beacons) // 2
    numbers = {id(beacon): number for number, beacon in enumerate(beacons)}

    def reset(beacon, one):
        late = numbers[id(beacon)] >= half and one.frame[9] == beacons[half].receptions[0][1].frame[9]
        return float((one.carrier_phase_cycles + 0.5 * late) % 1.0)

    as_they_are, before = fixes_of(with_phases(beacons, lambda _, one: one.carrier_phase_cycles))
    after, state = fixes_of(with_phases(beacons, reset))
    assert state.status.phases_opened > before.status.phases_opened
    stamps, _ = fixes_of(with_phases(beacons, lambda _, one: None))
    moved_m, by_stamps_m = (np.hypot(*(one - as_they_are).T) for one in (after, stamps))
    assert np.nanmax(moved_m) < np.nanmax(by_stamps_m)


@pytest.mark.parametrize(("rate_hz", "seconds"), [(67.0, 5.0), (17.0, 15.0)])
def test_constants_of_pairs_are_those_of_the_radios(rate_hz, seconds):
    """Each is the sum of one of the sender and one of the listener, so those of four pairs fit each other."""
    beacons = heard(3, seconds, site=plain(rate_hz), room=Room(axis_std_m=0.0))
    _, s = fixes_of(with_phases(beacons, lambda _, one: one.carrier_phase_cycles))
    wavelength_m, worst_m = 128 / 13 * TICK_M, 0.0
    for i, j, k, l in permutations(range(s.count), 4):  # noqa: E741
        links = (s.links[i][k], s.links[j][l], s.links[i][l], s.links[j][k])
        assert max(link.phase_variance_m2 for link in links) < 1e-3**2
        off_m = links[0].phase_m + links[1].phase_m - links[2].phase_m - links[3].phase_m
        worst_m = max(worst_m, abs(off_m - round(off_m / wavelength_m) * wavelength_m))
    assert worst_m < 4e-3


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("carrier", "most"),
    [
        (CarrierModel(), 0.9),
        (CarrierModel(slips=0.01), 1.05),
        (CarrierModel(wild=0.1), 1.05),
        (CarrierModel(reflections=RangeErrorModel(changing_m=0.008, correlation_m=0.05)), 1.05),
    ],
)
def test_the_room_with_phases_against_the_room_by_stamps(carrier, most):
    """Squared errors of the same tags, whose stamps are the same: fewer with phases, never more."""
    squares = np.zeros(2)
    for seed in range(1, 7):
        beacons = heard(100 + seed, 12.0, carrier=carrier)
        for place, change in enumerate((lambda _, one: None, lambda _, one: one.carrier_phase_cycles)):
            receptions = with_phases(beacons, change)
            found, _ = fixes_of(receptions)
            errors = np.sum((found - np.array([truth_m[:2] for _, truth_m in receptions])) ** 2, axis=1)
            squares[place] += np.nanmean(errors[len(errors) // 5 :])
    assert np.sqrt(squares[1] / squares[0]) < most


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("site", "qa", "carrier", "body", "most"),
    [
        (plain(67.0), 3.0, USUAL, None, 0.65),
        (plain(17.0), 3.0, USUAL, None, 1.0),
        (plain(17.0), 0.3, USUAL, None, 0.8),
        (plain(67.0, relays_phases=False), 3.0, USUAL, None, 0.7),
        (plain(10.0, relays_phases=False), 3.0, USUAL, None, 1.05),
        (plain(67.0, relays_phases=False), 3.0, CarrierModel(wild=0.1), None, 1.05),
        (plain(67.0, relays_phases=False), 3.0, CarrierModel(slips=0.01), None, 1.0),
        (plain(67.0, relays_phases=False), 3.0, USUAL, Body(), 1.15),
    ],
)
def test_phases_in_hands_and_walking_against_stamps(site, qa, carrier, body, most):
    """The same receptions of tags, plain crystals; levels are exceeded as often, but for 10⁻³ of the fixes."""
    low_m, high_m = box(SITE)
    plan = Plan(worlds=4, seed=5, seconds=10.0, conditions="phase", tags=4)

    def paths(seed):
        return [wanderer(low_m, high_m, seed, tag, qa) for tag in range(plan.tags)]

    def tallies(of):
        change = partial(replace, carrier=of)
        runs = worlds(plan, site, paths, room=Room(), warmup_s=2.5, change=change, **({"body": body} if body else {}))
        return [run_world(run) for run in runs]

    stamps, phases = tallies(None), tallies(carrier)
    assert sum(one.squared_m2 for one in phases) < most**2 * sum(one.squared_m2 for one in stamps)
    exceeded = [sum(one.levels.exceeded.sum() for one in found) for found in (stamps, phases)]
    assert exceeded[1] <= exceeded[0] + 1e-3 * sum(one.fixes for one in phases)
