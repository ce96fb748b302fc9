"""A clock that the test moves."""

import pytest
from dashboard_builders import Times


@pytest.fixture
def times():
    return Times()
