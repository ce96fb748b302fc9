"""How far the first path's power decides what a reception is worth."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.frame import MAX_VARIANCE_FACTOR, Diagnostics, variance_factor, variance_factor_of
from skyless.core.any_receiver import AnyReceiver
from skyless.core.fix import Fix
from skyless.core.protocol1.anchor import Anchor
from skyless.sim.impairments import AnchorBias, Impairments
from skyless.sim.lab import paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World
from skyless.site.channel import ChannelModel, first_path_loss_db

pytestmark = pytest.mark.site

POWERS = st.floats(-150.0, 0.0)


@pytest.mark.parametrize(
    ("difference_db", "least", "most"),
    [(0, 1, 1), (6, 1, 1), (10, 10, MAX_VARIANCE_FACTOR), (20, MAX_VARIANCE_FACTOR, MAX_VARIANCE_FACTOR)],
)
def test_the_makers_rule_of_thumb(difference_db, least, most):
    """DW1000 User Manual: below 6 dB likely a line of sight, above 10 dB likely none."""
    assert least <= variance_factor(-80.0, -80.0 - difference_db) <= most


@given(POWERS, POWERS, st.floats(0.0, 100.0))
def test_it_is_bounded_and_never_falls_with_the_difference(rx_dbm, first_dbm, less_db):
    factor, weaker = variance_factor(rx_dbm, first_dbm), variance_factor(rx_dbm, first_dbm - less_db)
    assert 1.0 <= factor <= weaker <= MAX_VARIANCE_FACTOR
    assert math.isfinite(factor)


@given(st.floats(0.0, 39.0))
def test_it_has_no_steps(difference_db):
    here, beyond = (variance_factor(0.0, -difference_db - more) for more in (0.0, 0.01))
    assert beyond - here < 0.01 * 2.0 * MAX_VARIANCE_FACTOR * math.log(MAX_VARIANCE_FACTOR) * 1.5 / 4.0


@pytest.mark.parametrize("nonsense", [None, math.nan, math.inf, -math.inf])
def test_what_is_not_told_or_impossible_says_nothing(nonsense):
    for powers in [(nonsense, -90.0), (-80.0, nonsense), (-90.0, -80.0), (nonsense, nonsense)]:
        assert variance_factor_of(Diagnostics(*powers)) == 1.0
    assert variance_factor_of(None) == 1.0


@pytest.mark.parametrize(("extra_m", "least_db", "most_db"), [(-1, 0, 6), (0, 0, 6), (0.05, 0, 6), (0.3, 8.5, 12)])
def test_emulated_paths_show_what_real_ones_do(extra_m, least_db, most_db):
    """In UTIL's recordings 5 cm of lateness show nothing, 0.2 m and more (metal) 11 dB and more."""
    assert least_db <= first_path_loss_db(extra_m) <= most_db


def _squared(method, diagnostics, told, *, bias_m=0.0, nlos=0.0):
    """Squared and normalised errors of a tag that lies still, shape (fixes,), and all fixes as bytes."""
    site = paper_lab_site(100.0)
    biases = (AnchorBias(2, bias_m),) if bias_m else ()
    channel = ChannelModel(nlos_probability=nlos)
    faults = Impairments(anchor_biases=biases, channel=channel, diagnostics=diagnostics)
    world = World(site, lambda anchor: Anchor(site, anchor), [TagSpec(Static(2.0, 3.0))], faults, 5)
    receiver, squared, normalised, seen = AnyReceiver(method), [], [], []
    for broadcast in world.run(4.0):
        for _, reception, truth_m in broadcast.receptions():
            heard = reception if told else type(reception)(reception.frame, reception.rx_ticks, reception.host_s)
            fix = receiver.hear(heard)
            if isinstance(fix, Fix) and broadcast.end_s > 1.0:
                error = (fix.position_m - truth_m)[:2]
                squared.append(error @ error)
                normalised.append(error @ np.linalg.solve(fix.covariance_m2[:2, :2], error) / 2.0)
                seen.append(fix.position_m.tobytes() + fix.covariance_m2.tobytes())
    return np.array(squared), np.array(normalised), seen


def test_clean_receptions_lose_nothing():
    *_, told = _squared("joint", True, True)
    *_, untold = _squared("joint", True, False)
    assert told == untold
    assert len(told) > 1000


@pytest.mark.parametrize(("fault", "least_gain"), [({"bias_m": 0.4}, 0.9), ({"nlos": 0.4}, 1.0)])
@pytest.mark.statistical
def test_blocked_paths_that_show_cost_less(fault, least_gain):
    """One anchor alone is found out by its innovations, too: there is nothing to gain, and little to lose."""
    squared, normalised, _ = _squared("joint", True, True, **fault)
    without, _, _ = _squared("joint", True, False, **fault)
    assert least_gain * np.sqrt(squared.mean()) <= np.sqrt(without.mean())
    assert squared.mean() < 0.03**2
    assert normalised.mean() < 2.0
