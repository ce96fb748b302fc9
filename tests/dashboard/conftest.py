"""What the dashboard's tests share: a live site, and in the place of a broker a wire."""

import pytest
from dashboard_builders import SITE_ID, Times, Wire

from skyless.page.live import LiveSite


@pytest.fixture
def times():
    return Times()


@pytest.fixture
def wire():
    return Wire()


@pytest.fixture
def live(times, wire):
    """Of a broker that is not connected yet."""
    live = LiveSite("here", "mqtt://broker:1", None, lambda: times.now_s, lambda: times.unix_s)
    live.attach(wire, SITE_ID)
    return live
