"""The table of what each mechanism of the estimator buys."""

import numpy as np
import pytest
from estimator_table import MECHANISMS, changed, constants, switched

from skyless.core.air.frame import variance_factor
from skyless.core.estimator import estimator, settings
from skyless.core.estimator.state import new_state


@pytest.mark.parametrize("changes", MECHANISMS.values(), ids=MECHANISMS)
def test_a_mechanism_can_be_switched_off_and_is_on_again(changes):
    before = settings.TUNING
    with switched(changes):
        fields = {name: value for name, value in changes.items() if ":" not in name}
        assert {name: getattr(estimator.TUNING, name) for name in fields} == fields
        assert all(getattr(new_state(settings.EstimatorSettings()).tuning, name) == fields[name] for name in fields)
    assert settings.TUNING is before
    assert estimator.TUNING is before


def test_weak_first_paths_count_as_others_where_that_is_off():
    assert variance_factor(-80.0, -89.0) > 1.0
    with switched(MECHANISMS["… weak first paths"]):
        assert variance_factor(-80.0, -89.0) == variance_factor(-80.0, -95.0) == 1.0


def test_each_constant_is_doubled_and_halved_where_that_makes_sense():
    found = constants()
    assert len(found) == 2 * len(settings.Tuning.__annotations__)
    assert found["`suspect` ÷ 2"] == {"suspect": 1.5}
    assert found["`noise_loss` × 2"]["noise_loss"] == pytest.approx(0.98)


def world(rmse_m, exceeded=0.0, fixes=100.0):
    return np.array([[fixes, fixes * rmse_m**2, fixes, fixes, exceeded]])


@pytest.mark.parametrize(
    ("off_m", "text"),
    [
        ((0.02, 0.03, 0.04), ""),
        ((0.0203, 0.0304, 0.0406), ""),
        ((0.021, 0.0316, 0.042), "1.05"),
        ((0.02, 0.03, 0.06), "(1.30)"),
        ((0.021, 0.029, 0.0405), ""),
    ],
)
def test_a_change_is_shown_beyond_the_scatter_of_worlds(off_m, text):
    assert changed([world(one) for one in (0.02, 0.03, 0.04)], [world(one) for one in off_m]) == text


def test_levels_that_are_exceeded_are_shown_always():
    assert changed([world(0.02)] * 3, [world(0.02), world(0.02), world(0.02, 2.0)]) == "**+2 exceeded**"
