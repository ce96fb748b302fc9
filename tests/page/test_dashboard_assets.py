"""Assets at the page's server: kept by the broker and in a file, shown to pages."""

import json

import pytest
from dashboard_builders import SITE, SITE_ID

from skyless.core.errors import SkylessError
from skyless.page.live import LiveSite
from skyless.page.site_assets import SETTLE_S, AssetsFile
from skyless.run.assets import read_csv, write_csv
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import Asset, AssetsMessage, WrongMessageError

TOPIC = topics.assets_topic(SITE_ID)
NAME = SITE.site.name
FORKLIFT = Asset("t1", "Forklift 1", "forklifts", colour="#c2410c")
PALLET = Asset("t2", "Pallet", "pallets")


@pytest.fixture
def file(tmp_path):
    return tmp_path / "assets.csv"


@pytest.fixture
def start(times, wire):
    """Start the page's server with a file."""

    def start(path=None):
        file = None if path is None else AssetsFile(path)
        live = LiveSite("here", "mqtt://broker:1", SITE, lambda: times.now_s, lambda: times.unix_s, assets_file=file)
        live.attach(wire, SITE_ID)
        live.on_connection(connected=True)
        return live

    return start


def kept(wire):
    """What the broker has been given, the newest last."""
    return [
        json.loads(payload)
        for topic, payload, qos, retain in wire.published
        if topic == TOPIC and (qos, retain) == (1, True)
    ]


def settle(live, times):
    times.move(SETTLE_S + 0.1)
    live.tick()


def test_pages_get_them_first_and_with_each_change(start, wire):
    live = start()
    page = live.open_page()
    assert json.loads(page._latest["assets"]) == {"type": "assets", "assets": []}
    live.assets.store((FORKLIFT,))
    assert json.loads(page._latest["assets"])["assets"][0]["name"] == "Forklift 1"
    assert kept(wire)[-1]["site"] == NAME
    wire.deliver(TOPIC, AssetsMessage((FORKLIFT,), NAME))  # the echo
    wire.deliver(TOPIC, AssetsMessage((PALLET,), NAME))  # of another dashboard
    assert live.assets.by_tag == {"t2": PALLET}
    assert wire.forgotten == [TOPIC]
    wire.deliver(TOPIC, b"")
    assert live.assets.by_tag == {}


def test_a_broker_without_any_is_given_the_files(start, file, wire, times):
    file.write_bytes(write_csv([FORKLIFT]))
    live = start(file)
    live.tick()
    assert kept(wire) == []
    settle(live, times)
    assert kept(wire)[-1]["assets"][0]["tag"] == "t1"
    settle(live, times)
    assert len(kept(wire)) == 1


@pytest.mark.parametrize("assets", [(PALLET,), ()])
def test_what_the_broker_has_comes_before_the_file(start, file, wire, times, assets):
    file.write_bytes(write_csv([FORKLIFT]))
    live = start(file)
    wire.deliver(TOPIC, AssetsMessage(assets, NAME))
    settle(live, times)
    assert kept(wire) == []
    assert live.assets.by_tag == {one.tag: one for one in assets}
    assert read_csv(file.read_bytes()) == assets
    assert read_csv((file.parent / "assets.csv.old").read_bytes()) == (FORKLIFT,)


def test_the_file_is_written_with_each_change(start, file, wire):
    live = start(file)
    assert not file.exists()
    live.assets.store((FORKLIFT, PALLET))
    assert read_csv(file.read_bytes()) == (FORKLIFT, PALLET)
    wire.deliver(TOPIC, AssetsMessage((FORKLIFT, PALLET), NAME))
    wire.deliver(TOPIC, AssetsMessage((PALLET,), NAME))
    assert read_csv(file.read_bytes()) == (PALLET,)
    assert [path.name for path in file.parent.iterdir()] == ["assets.csv"]


def test_assets_that_come_before_their_site_is_known_are_written(times, wire, file):
    live = LiveSite(
        "here", "mqtt://broker:1", None, lambda: times.now_s, lambda: times.unix_s, assets_file=AssetsFile(file)
    )
    live.attach(wire, SITE_ID)
    wire.deliver(TOPIC, AssetsMessage((PALLET,), NAME))
    assert not file.exists()
    wire.deliver(topics.site_topic(SITE_ID), SITE)
    assert read_csv(file.read_bytes()) == (PALLET,)


def test_a_file_that_cannot_be_written_costs_no_change(start, file, caplog):
    live = start(file)
    file.parent.rename(file.parent.with_name("gone"))
    live.assets.store((FORKLIFT,))
    assert live.assets.by_tag == {"t1": FORKLIFT}
    assert "cannot be written" in caplog.text


@pytest.mark.parametrize("content", [b"tag,colour\nt1,red\n", b"\xff"])
def test_a_wrong_file_is_refused_at_the_start(file, content):
    file.write_bytes(content)
    with pytest.raises(SkylessError, match=r"assets\.csv: line [12]"):
        AssetsFile(file)
    with pytest.raises(SkylessError, match="folder"):
        AssetsFile(file.parent / "none" / "assets.csv")
    with pytest.raises(SkylessError, match="cannot be read"):
        AssetsFile(file.parent)


def test_another_sites_are_neither_shown_nor_overwritten(start, wire, file):
    live = start(file)
    wire.deliver(TOPIC, AssetsMessage((FORKLIFT,), "another"))
    assert live.assets.by_tag == {}
    with pytest.raises(WrongMessageError, match="'another'"):
        live.assets.store((PALLET,))
    assert kept(wire) == []
    assert not file.exists()
