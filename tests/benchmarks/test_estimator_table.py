"""The table of what each mechanism of the estimator buys."""

import pytest
from estimator_table import MECHANISMS, switched

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
