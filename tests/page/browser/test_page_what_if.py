"""A piece of a recording is recomputed by WebAssembly in the browser, as the library does it on the host."""

import socket
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import uvicorn
from msgspec.structs import replace

from skyless.core.errors import SkylessError
from skyless.core.estimator import compiled
from skyless.core.estimator.process import REJECTED, STALE, BatchPacket, BatchRow, Place, Relay
from skyless.core.estimator.state import State
from skyless.core.native.library import SOURCE, source_digest
from skyless.core.native.views import records
from skyless.page.app import Services, make_app
from skyless.page.connections import AccessRules
from skyless.page.live import LiveSite
from skyless.page.playback import Playback
from skyless.page.sites import LiveSites
from skyless.page.tasks import WhatIfTask
from skyless.page.what_if_process import what_if
from support import live_site

sys.path.insert(0, str(Path(__file__).parents[3] / "tools"))
import wasm_core

TAG = "a"


def recorded_in(made, **schedule):
    """A folder with a recording of a tag at a site without a master."""
    with pytest.MonkeyPatch.context() as patched:
        for name in ("LAB", "SITE"):
            site = getattr(live_site, name)
            patched.setattr(live_site, name, replace(site, schedule=replace(site.schedule, mode="free", **schedule)))
        live_site.record(made / "lab.mcap", live_site.messages(4.0, (TAG,)))
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return recorded_in(tmp_path_factory.mktemp("recordings"))


@pytest.fixture
def server(folder):
    """The page's own server, with that recording."""
    live = LiveSite("here", "mqtt://broker:1", None, lambda: 100.0, lambda: 1000.0)
    app = make_app(Services(LiveSites(live), Playback(folder)), AccessRules())
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        running = uvicorn.Server(uvicorn.Config(app, ws="websockets-sansio", log_config=None))
        thread = threading.Thread(target=running.run, args=([sock],), daemon=True)
        thread.start()
        while not running.started:
            time.sleep(0.02)
        yield SimpleNamespace(address=f"http://127.0.0.1:{sock.getsockname()[1]}")
        running.should_exit = True
        thread.join()


def prepared_of(folder):
    return what_if(WhatIfTask(str(folder / "lab.mcap"), TAG, live_site.UNIX_S, 3.0))


@pytest.fixture(scope="module")
def prepared(folder):
    return prepared_of(folder)


def on_the_host(found, without=(), moved_m=(0.0, 0.0, 0.0), noise=1.0):
    """What the library makes of the same tables, with the same changes."""
    content = bytearray(found.layout["State"])
    for at, page in found.state:
        content[at : at + len(page)] = page
    state = State.from_buffer(content)
    state.settings.tx_variance_m2 *= noise**2
    state.settings.rx_variance_m2 *= noise**2
    places = np.frombuffer(bytearray(found.places), np.dtype(Place))
    places["position_m"][0] += moved_m
    given, relays = np.frombuffer(found.packets, np.dtype(BatchPacket)), np.frombuffer(found.relays, np.dtype(Relay))
    begins = np.append(0, given["end"][:-1])
    kept = [k for k, one in enumerate(given["place"]) if found.anchors[one].id not in without]
    parts = [relays[begins[k] : given["end"][k]] for k in kept]
    packets = given[kept].copy()
    packets["end"] = np.cumsum([len(part) for part in parts])
    rows = np.zeros(len(kept), np.dtype(BatchRow))
    compiled.track(
        state,
        records(Place, places),
        records(BatchPacket, packets),
        records(Relay, np.concatenate(parts)),
        records(BatchRow, rows),
        len(kept),
        True,
    )
    return rows


RECOMPUTE = """
  const found = await api.whatIf(...given.what, 0, 3);
  const rows = [];
  for (const { without, moved_m, noise } of given.changes) {
    const moved = new Map([[found.anchors[0].id, moved_m]]);
    rows.push(await estimator.recompute(found, { without: new Set(without), moved_m: moved, noise }));
  }
  return rows.map((one) => one.map(({ used, position_m }) => [used, ...position_m]));"""


@pytest.mark.statistical
def test_the_browser_gives_the_bits_of_the_host(server, prepared, visit):
    nothing = {"without": [], "moved_m": [0.0, 0.0, 0.0], "noise": 1.0}
    changes = ({}, {"without": [prepared.anchors[0].id]}, {"moved_m": [0.3, -0.2, 0.1]}, {"noise": 3.0})
    changes = [nothing | change for change in changes]
    shown = visit(server).run("api estimator", RECOMPUTE, {"what": ["lab.mcap", TAG], "changes": changes})
    for change, rows in zip(changes, shown, strict=True):
        expected = on_the_host(prepared, **change)
        assert [row[1:] for row in rows] == expected["position_m"].tolist(), change
        assert [row[0] for row in rows] == [outcome not in (REJECTED, STALE) for outcome in expected["outcome"]]
        assert sum(row[0] for row in rows) > 200


def test_nothing_changed_is_what_the_tag_computed(prepared):
    """But for where the filter begins: it knows less of clocks and range errors than the tag's did."""
    rows = on_the_host(prepared)
    pairs = [(then[:2], row["position_m"][:2]) for then, row in zip(prepared.recorded, rows, strict=True) if then]
    away_m = np.array([np.hypot(*(np.array(then) - now)) for then, now in pairs])
    assert len(pairs) > 200
    assert np.median(away_m) < 0.02
    assert away_m[len(away_m) // 2 :].max() < 0.05


@pytest.mark.site
def test_relays_with_phases_are_recomputed_like_those_without(prepared, tmp_path):
    """Their stamps are short, and whole ones are made of them where they are used."""
    with_phases = prepared_of(recorded_in(tmp_path, carrier_phase=True))
    assert np.frombuffer(with_phases.relays, np.dtype(Relay))["is_short"].all()
    assert not np.frombuffer(prepared.relays, np.dtype(Relay))["is_short"].any()
    assert on_the_host(with_phases).tobytes() == on_the_host(prepared).tobytes()


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ({"tag": "nobody"}, "tag nobody has no fix"),
        ({"begin_unix_s": 2e9}, "has no fix from there on"),
        ({"path": "/nowhere.mcap"}, "nowhere.mcap"),
    ],
)
def test_why_there_is_nothing_to_recompute(folder, task, words):
    usual = WhatIfTask(str(folder / "lab.mcap"), TAG, live_site.UNIX_S, 3.0)
    with pytest.raises(SkylessError, match=words):
        what_if(replace(usual, **task))


@pytest.mark.statistical
def test_the_dialog(server, visit):
    shown = visit(server)
    page = shown.page
    page.click("#tab-recordings")
    page.click(".recording")
    shown.until("skyless.state.mode === 'replay' && !skyless.state.player.waiting")
    page.click("#what-if")
    shown.until("document.querySelectorAll('#what-if-figures tr').length === 5")
    rows = page.locator("#what-if-dialog table").first.locator("tr")
    problem = "document.querySelector('#what-if-dialog .problem').textContent"
    for number in (1, 2, 3, 4):
        rows.nth(number).locator("input[type=checkbox]").uncheck()
    page.click("#what-if-run")
    shown.until(f"{problem}.includes('needs 3 anchors')")
    rows.nth(1).locator("input[type=checkbox]").check()
    for noise, said in (("1000", ".includes('from 0.1 to 100')"), ("2", " === ''")):
        page.fill("#what-if-noise", noise)
        page.click("#what-if-run")
        shown.until(f"{problem}{said}")
    page.click("#what-if-dialog > button")
    shown.until("document.querySelector('#what-if-dialog') === null")


def test_the_webassembly_is_of_the_source():
    """It is committed, as browsers need it where there is no clang; another version of clang gives other bytes."""
    committed = wasm_core.PAGE.read_bytes()
    assert source_digest(SOURCE).encode() in committed, "run python tools/wasm_core.py"
