"""Real brokers, and links that the test plays."""

import pytest
from node_stage import FakeLink

from support.mqtt_brokers import MOSQUITTO, Embedded, Mosquitto


@pytest.fixture(params=["embedded", "mosquitto"])
def make_broker(request, tmp_path):
    """A function that makes a broker (not yet started) with its store in a folder of its own."""
    if request.param == "mosquitto" and MOSQUITTO is None:
        pytest.skip("mosquitto is not installed")
    kind = Embedded if request.param == "embedded" else Mosquitto

    def make(name="broker", **settings):
        folder = tmp_path / name
        folder.mkdir()
        return kind(folder, **settings)

    return make


@pytest.fixture
def links(monkeypatch):
    """Links of ``node_stage.FakeLink``, in the order in which they were made."""
    monkeypatch.setattr(FakeLink, "made", [])
    return FakeLink.made
