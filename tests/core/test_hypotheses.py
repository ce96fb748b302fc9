"""Hypotheses on cycles of phases: against a mixture of filters of their own, and what they are weighed by."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.core.estimator.hypotheses import (
    give_up_hypotheses,
    scatter,
    settle_hypotheses,
    spread_of_h,
    take_cycles,
    wavelength_m,
)
from skyless.core.estimator.kalman import (
    add_clock_noise,
    compute_fault_input,
    compute_ph,
    finish_updates,
    predict,
    update_later,
)
from skyless.core.estimator.measurements import add_term
from skyless.core.estimator.monitor import learn_least_walk, motion_covariance
from skyless.core.estimator.phases import _count_wild
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import add_anchor, at, covariances, make_uncertain, new_state, use_phases
from skyless.core.native.records import HYPOTHESES
from skyless.core.native.views import view
from skyless.core.ticks import TICK_S

CYCLE_M = wavelength_m(new_state(EstimatorSettings()))
ANCHORS = 3


def state_of(draw):
    """A state with anchors and ambiguities, of random values and covariance."""
    s = new_state(EstimatorSettings(height_m=0.0))
    for anchor in range(ANCHORS):
        add_anchor(s, anchor, (float(anchor), 5.0 * (anchor % 2), 0.0), -1.0, False)
    use_phases(s)
    make_uncertain(s, 0)
    root = draw.normal(0.0, 0.02, (s.used, s.used))
    covariances(s)[: s.used, : s.used] = root @ root.T / s.used
    view(s.x)[: s.used] = draw.normal(0.0, 1.0, s.used)
    return s


class Mixture:
    """The same by textbook: vectors, weights and one covariance."""

    def __init__(self, s):
        self.x = [view(s.x)[: s.used].copy()]
        self.log_weight = np.zeros(1)
        self.P = covariances(s)[: s.used, : s.used].copy()

    def process(self, h, value, variance, cycles=(0,)):
        """Each cycle within 4σ; where each vector has one at most, the nearest, however far."""
        innovation_variance = h @ self.P @ h + variance
        gain, found = self.P @ h / innovation_variance, []
        offs = [[value + cycle * CYCLE_M - h @ x for cycle in cycles] for x in self.x]
        near = [[off for off in each if off * off <= 16.0 * innovation_variance] for each in offs]
        if max(map(len, near)) <= 1:
            near = [[min(each, key=abs)] for each in offs]
        for x, log_weight, each in zip(self.x, self.log_weight, near, strict=True):
            found += [(x + gain * off, log_weight - 0.5 * off * off / innovation_variance) for off in each]
        found.sort(key=lambda one: -one[1])
        found = [one for one in found[:HYPOTHESES] if one[1] - found[0][1] >= -10.0]
        self.x, self.log_weight = [x for x, _ in found], np.array([log_weight for _, log_weight in found])
        self.P = self.P - np.outer(gain, gain) * innovation_variance

    def mean_and_scatter(self):
        weights = np.exp(self.log_weight - self.log_weight.max())
        weights /= weights.sum()
        mean = weights @ np.array(self.x)
        off = np.array(self.x) - mean
        return mean, (weights[:, None] * off).T @ off


def measure(s, h):
    s.terms = 0
    for index in np.flatnonzero(h).tolist():
        add_term(s, index, float(h[index]))
    return compute_ph(s)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), kinds=st.lists(st.booleans(), min_size=1, max_size=8))
def test_hypotheses_are_a_mixture_of_filters_with_one_covariance(seed, kinds):
    draw = np.random.default_rng(seed)
    s = state_of(draw)
    s.tuning.alike = 0.0
    mixture = Mixture(s)
    for is_phase in kinds:
        h = np.zeros(s.used)
        h[draw.choice(s.used, 3, replace=False)] = draw.normal(0.0, 1.0, 3)
        off, variance = float(draw.normal(0.0, 0.02)), float(draw.uniform(1e-6, 1e-4))
        value = h @ view(s.x)[: s.used] + off
        predicted = measure(s, h)
        compute_fault_input(s, -1)
        offs = (np.array(mixture.x) - mixture.mean_and_scatter()[0]) @ h
        likely, weights = np.argmax(mixture.log_weight), np.exp(mixture.log_weight - mixture.log_weight.max())
        wrapped = np.remainder(offs - offs[likely] + CYCLE_M / 2, CYCLE_M) - CYCLE_M / 2
        spread = (offs[likely], weights @ wrapped**2 / weights.sum())
        assert spread_of_h(s) == pytest.approx(spread, abs=1e-9)
        if is_phase:
            if not take_cycles(s, off, predicted + variance, 4.0 * np.sqrt(predicted + variance)):
                return
        else:
            update_later(s, off, predicted + variance)
        finish_updates(s)
        settle_hypotheses(s)
        mixture.process(h, value, variance, range(-40, 41) if is_phase else (0,))
        mean, spread = mixture.mean_and_scatter()
        assert s.hypotheses.count == len(mixture.x)
        np.testing.assert_allclose(view(s.x)[: s.used], mean, atol=1e-9)
        found = [[scatter(s, one, other) for other in range(4)] for one in range(4)]
        np.testing.assert_allclose(found, spread[:4, :4], atol=1e-11)
        assert motion_covariance(s, 0, 1) == pytest.approx(s.P[at(0, 1)] + spread[0, 1], abs=1e-12)
    whole = mixture.P + mixture.mean_and_scatter()[1]
    give_up_hypotheses(s)
    assert s.hypotheses.count == 1
    np.testing.assert_allclose(covariances(s)[: s.used, : s.used], whole, atol=1e-10)


def test_hypotheses_that_have_become_alike_are_merged():
    """One differs from the others by whole cycles of ambiguities alone, which no measurement can show."""
    s = state_of(np.random.default_rng(5))
    view(s.V)[: s.used, s.rows - 1 : s.rows + 2] = np.random.default_rng(6).normal(0.0, 1.0, (s.used, 1))
    first, s.hypotheses.count, s.rows = s.rows - 1, 3, s.rows + 2
    view(s.V)[0, first + 1] += 1.0
    view(s.V)[s.layout.mesh : s.layout.mesh + 2, first + 2] += (CYCLE_M, -3.0 * CYCLE_M)
    view(s.hypotheses.log_weight)[:3] = np.log((0.5, 0.2, 0.3))
    x, deviation = float(s.x[0]), float(s.V[0][first])
    settle_hypotheses(s)
    assert s.hypotheses.count == 2
    assert sorted(view(s.hypotheses.weight)[:2]) == pytest.approx([0.2, 0.8])
    assert s.x[0] == pytest.approx(x + deviation + 0.2)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), parts=st.lists(st.floats(0.0, 0.1), min_size=1, max_size=5))
def test_noise_of_a_clock_is_the_same_in_parts_and_later(seed, parts):
    """Against the noise that time updates add at once, in a state whose relays are not processed in order."""
    once, later = (state_of(np.random.default_rng(seed)) for _ in range(2))
    once.status.is_in_order = False
    ends = np.round(np.cumsum(parts) / TICK_S).astype(int).tolist()
    for s in (once, later):
        s.settings.walk, s.settings.white = 2.0, 1e-5
        predict(s, ends[-1])
    for anchor in range(ANCHORS):
        for end in ends:
            add_clock_noise(later, anchor, end)
    np.testing.assert_allclose(covariances(later), covariances(once), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("anchors_walk", "tag_walk"), [(2.25, 0.09), (0.09, 2.25), (0.05, 0.05)])
def test_the_random_walk_of_clocks_is_found_from_their_rates(anchors_walk, tag_walk):
    """In the mean over its memory of 20 changes, within what 20 and 40 numbers with χ² allow in one of 10⁴ cases."""
    s, draw, step_s, factors = state_of(np.random.default_rng(3)), np.random.default_rng(4), 0.05, []
    s.count = ANCHORS
    rates, offsets = np.zeros(ANCHORS), np.zeros(ANCHORS)
    for anchor in range(ANCHORS):
        s.anchors[anchor].has_rate = True
    for step in range(1, 4000):
        change = draw.normal(0.0, np.sqrt(tag_walk * step_s)) + draw.normal(
            0.0, np.sqrt(anchors_walk * step_s), ANCHORS
        )
        offsets += (rates + 0.5 * change) * step_s
        rates += change
        view(s.x)[s.layout.offset : s.layout.offset + ANCHORS] = offsets
        s.status.epoch_ticks = round(step * step_s / TICK_S)
        learn_least_walk(s)
        if s.status.rate_changes >= 20:
            of_tag = s.status.tag_walk / (tag_walk + anchors_walk / ANCHORS)
            factors.append((s.status.anchors_walk / anchors_walk, of_tag))
    low, high = np.min(factors, axis=0), np.max(factors, axis=0)
    assert (low > (0.3, 0.2)).all()
    assert (high < (2.5, 3.2)).all()
    assert np.mean(factors, axis=0) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_the_share_of_wild_phases_is_found_while_predictions_are_certain_to_a_seventh_of_a_wavelength(share):
    s, draw, std_m = state_of(np.random.default_rng(1)), np.random.default_rng(2), CYCLE_M / 7.0
    found = []
    for _ in range(6000):
        off_m = draw.uniform(-0.5, 0.5) * CYCLE_M if draw.random() < share else draw.normal(0.0, std_m)
        _count_wild(s, off_m, std_m**2)
        found.append(s.status.wild_share)
    assert np.mean(found[2000:]) == pytest.approx(share, abs=0.01 if share == 0.0 else 0.03)
