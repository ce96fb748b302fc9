"""The Cramér–Rao bound with phases of the carrier: against a textbook's matrices, and against that without them."""

import numpy as np
import pytest
from textbook_bound import LAB, PHASES, ROOM, SLOT_S, settings_of, textbook, walk

from skyless.core.estimator.state import covariances
from skyless.core.estimator.steady_state import process_known
from skyless.core.native.library import compiled
from skyless.core.ticks import TICK_S
from skyless.research.uncertainty import Biases, Sendings, _prior, received_bound, tracking_bound


@pytest.mark.parametrize("biases", [Biases(), ROOM])
def test_phases_never_raise_the_bound_and_ones_of_endless_noise_leave_it(biases):
    path = walk()
    without = tracking_bound(LAB, path, settings_of(), biases)
    found = tracking_bound(LAB, path, settings_of(**PHASES), biases)
    for one, other in zip(without, found, strict=True):
        assert np.linalg.eigvalsh(one - other).min() > -1e-9
    assert np.trace(found[-1]) < 0.9 * np.trace(without[-1])
    noisy = tracking_bound(LAB, path, settings_of(phase_std_m=1e6), biases)
    np.testing.assert_allclose(noisy, without, rtol=1e-6, atol=1e-12)


def last_of(path, settings):
    """Covariance of position and velocity after the last frame, by the estimator's own steps."""
    s = _prior(LAB, settings, Biases())
    for frame, place in enumerate(path):
        known = np.ones(7, np.uint8)
        known[frame % 6] = 0
        compiled(process_known)(s, frame % 6, round(frame * SLOT_S / TICK_S), place, known, 0, 6 * SLOT_S, 0.0)
    tag = [0, 1, s.layout.velocity, s.layout.velocity + 1]
    return covariances(s)[np.ix_(tag, tag)].copy()


def test_a_tag_at_rest_learns_its_velocity_from_phases():
    path = np.tile([2.0, 3.0, 0.0], (6 * 30, 1))
    without, found = last_of(path, settings_of()), last_of(path, settings_of(**PHASES))
    np.testing.assert_allclose(found, textbook(LAB, path, settings_of(**PHASES))[-1], rtol=2e-3, atol=1e-7)
    assert np.sqrt(np.trace(found[2:, 2:]) / np.trace(without[2:, 2:])) < 0.6


def test_at_rest_phases_hardly_tell_where_a_tag_is_and_after_a_metre_of_walking_they_do():
    """What is constant at rest, errors of ranges and ambiguities, changes with the directions as the tag walks."""
    steps = np.linspace(0.0, 1.0, 6 * 70)[:, None] * [1.0, 0.0, 0.0]
    walked = np.add([2.0, 3.0, 0.0], steps)
    rest = np.tile(walked[-1], (len(walked), 1))

    def std_m(path, **phases):
        settings = settings_of(qa=0.05, **phases)
        return np.sqrt(np.trace(tracking_bound(LAB, path, settings, ROOM)[-1]))

    phases = {"phase_std_m": 0.0005}
    assert std_m(rest) > std_m(rest, **phases) > 0.92 * std_m(rest)
    assert std_m(walked) > 0.9 * std_m(rest)
    assert std_m(walked, **phases) < 0.85 * std_m(rest)


def test_only_what_the_tag_receives_has_a_phase():
    known = np.ones((60, 7), np.bool_)
    known[:, -1] = np.arange(60) % 6 != 2
    senders = np.arange(60) % 6
    known[np.arange(60), senders] = False
    rest = np.tile([2.0, 3.0, 0.0], (60, 1))
    sendings = Sendings(senders, SLOT_S * np.arange(60))
    bounds = [received_bound(LAB, rest, settings_of(**phases), known, sendings)[-1] for phases in ({}, PHASES)]
    assert np.linalg.eigvalsh(bounds[0] - bounds[1]).min() > 0.0
