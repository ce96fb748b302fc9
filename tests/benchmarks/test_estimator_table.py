"""The table of what each mechanism of the estimator buys."""

import pytest
from estimator_table import MECHANISMS, switched

from skyless.core.air.first_path import variance_factor
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
