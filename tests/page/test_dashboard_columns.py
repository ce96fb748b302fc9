"""Columns of a large site, and the binary messages of /live2, decoded by ``struct`` as docs/batches.md states them."""

import json
import struct
import time

import numpy as np
import pytest
from dashboard_builders import SITE, SITE_ID, Wire, browser_of
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from skyless.page import gathered as columns_module
from skyless.page.app import Services, make_app
from skyless.page.connections import AccessRules
from skyless.page.gathered import Columns, Gathered, View, anchors_message, conditions_message, tags_message
from skyless.page.live import LiveSite
from skyless.page.sites import LiveSites
from skyless.run.fix_batch import RECORD
from skyless.run.gather.subjects import NatsAddress

VIEW = View((0.0, 0.0, 10.0, 5.0), (1000, 500))


def records_of(rows):
    """Records of rows (tag, unix_us, x_mm, y_mm)."""
    records = np.zeros(len(rows), RECORD)
    for record, (tag, unix_us, x_mm, y_mm) in zip(records, rows, strict=True):
        record["tag"], record["unix_us"], record["flags"] = tag, unix_us, tag % 6
        record["position_mm"], record["covariance_m2"] = (x_mm, y_mm, 1000), (0.0009, 0.0, 0.0016)
    return records


rows = st.lists(
    st.tuples(
        st.integers(1, 3000), st.integers(10**15, 10**15 + 50), st.integers(-9000, 15_000), st.integers(-9000, 9000)
    ),
    max_size=60,
)


@settings(max_examples=40)
@given(st.lists(rows, max_size=5))
def test_the_columns_are_those_of_a_dictionary_of_newest_fixes(batches):
    columns, newest = Columns(), {}
    for batch in batches:
        columns.update(records_of(batch), 50.0)
        for tag, unix_us, x_mm, y_mm in batch:
            if unix_us >= newest.get(tag, (0,))[0]:
                newest[tag] = (unix_us, x_mm, y_mm)
    inside = {tag: xy for tag, (_, *xy) in newest.items() if 0 <= xy[0] <= 10_000 and 0 <= xy[1] <= 5000}
    found, ages_s = columns.visible(VIEW.view, 51.0)
    assert found["tag"].tolist() == sorted(inside)
    assert found["position_mm"][:, :2].tolist() == [inside[n] for n in sorted(inside)]
    assert ages_s.tolist() == [1.0] * len(inside)
    message = tags_message(columns, VIEW, 51.0, 123_456)
    kind, zero, count, unix_us = struct.unpack_from("<BBHQ", message)
    assert (chr(kind), zero, count, unix_us) == ("P", 0, len(inside), 123_456)
    points = list(struct.iter_unpack("<IHHHBB", message[12:]))
    assert [point[0] for point in points] == sorted(inside)
    for tag, x, y, sigma_mm, freshness, alert in points:
        assert (sigma_mm, freshness, alert) == (50, 10, tag % 6)
        assert abs(x / 65535 * 10_000 - inside[tag][0]) < 0.1
        assert abs(y / 65535 * 5000 - inside[tag][1]) < 0.1


def test_a_late_fix_changes_nothing_but_a_clock_that_was_set_back_does():
    columns = Columns()
    for unix_us, x_mm in ((10**15, 1000), (10**15 - 9_000_000, 2000), (10**15 - 3_600_000_000, 3000)):
        columns.update(records_of([(5, unix_us, x_mm, 1000)]), 1.0)
        shown = columns.visible(VIEW.view, 1.0)[0]["position_mm"][:, 0].tolist()
        assert shown == ([3000] if x_mm == 3000 else [1000])


def test_tags_that_are_unheard_leave_the_map_and_too_large_numbers_are_counted():
    columns = Columns()
    columns.update(records_of([(5, 10**15, 1000, 1000), (2**31, 10**15, 1000, 1000)]), 1.0)
    assert columns.dropped == 1
    assert columns.visible(VIEW.view, 10.9)[0]["tag"].tolist() == [5]
    assert len(columns.visible(VIEW.view, 11.1)[0]) == 0


@settings(max_examples=30)
@given(st.lists(st.sets(st.integers(1, 50), min_size=1), min_size=1, max_size=12), st.integers(1, 60))
def test_the_newest_fix_of_each_tag_is_due_once_and_who_waits_longest_comes_first(batches, most):
    columns, now_s, popped, waiting = Columns(), 100.0, {}, {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(columns_module, "MAX_DUE", most)
        for index, tags in enumerate(batches):
            now_s += 0.1
            columns.update(records_of([(tag, 10**15 + index, index, 1) for tag in tags]), now_s)
            waiting |= dict.fromkeys(tags, (index, now_s))
            assert columns.heard_since(now_s - 0.1) == sorted(tags)
            now_s += 0.1
            records, arrived_s = columns.pop_due(now_s)
            due = {tag for tag in waiting if now_s - popped.get(tag, 0.0) >= 0.5 - 1e-9}
            found = records["tag"].tolist()
            assert len(found) == min(len(due), most)
            assert set(found) <= due
            assert all(popped.get(a, 0.0) <= popped.get(b, 0.0) for a in found for b in due - set(found))
            for tag, x_mm, at_s in zip(found, records["position_mm"][:, 0], arrived_s, strict=True):
                assert (x_mm, at_s) == waiting.pop(tag)
                popped[tag] = now_s


def test_tags_that_are_to_be_first_do_not_wait():
    columns = Columns()
    for time_s, first, due in ((100.0, [], [5, 6]), (100.2, [5], [5]), (100.4, [6], [6])):
        columns.update(records_of([(5, 10**15, 1, 1), (6, 10**15, 1, 1)]), time_s)
        assert columns.pop_due(time_s + 0.1, first)[0]["tag"].tolist() == due
    assert len(columns.pop_due(100.6, [6])[0]) == 0


@settings(max_examples=20)
@given(st.integers(1, 16_384), st.integers(1, 16_384), st.randoms(use_true_random=False))
def test_many_tags_are_counts_of_cells_that_add_up(width, height, random):
    positions = [(random.randint(0, 10_000), random.randint(0, 5000)) for _ in range(300)]
    columns = Columns()
    columns.update(records_of([(n + 1, 10**15, x, y) for n, (x, y) in enumerate(positions)]), 1.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(columns_module, "MAX_POINTS", 200)
        message = tags_message(columns, replace(VIEW, px=(width, height)), 1.0, 9)
    kind, cell, across, along, zero, unix_us = struct.unpack_from("<BBHHHQ", message)
    assert (chr(kind), zero, unix_us) == ("B", 0, 9)
    assert (across - 1) * cell < width <= across * cell
    assert (along - 1) * cell < height <= along * cell
    assert across * along <= 16_384
    counts = np.frombuffer(message, "<u2", offset=16).reshape(along, across)
    assert counts.sum() == 300
    x, y = positions[0]
    assert counts[min(int(y / 5000 * height / cell), along - 1), min(int(x / 10_000 * width / cell), across - 1)]


def test_anchors_and_their_conditions():
    anchors = SITE.site.anchors
    message = anchors_message(anchors, 7)
    assert struct.unpack_from("<BBHQ", message) == (ord("A"), 0, len(anchors), 7)
    for found, anchor in zip(struct.iter_unpack("<HiihBB", message[12:]), anchors, strict=True):
        assert found[0] == anchor.id
        assert np.allclose(found[1:4], (1000 * anchor.x_m, 1000 * anchor.y_m, 100 * anchor.z_m), atol=0.5)
        assert found[4:] == (anchor.floor, 0)
    conditions = {str(anchors[0].id): "good", str(anchors[1].id): "warn", str(anchors[2].id): "bad"}
    message = conditions_message(anchors, conditions, 7)
    assert struct.unpack_from("<BBHQ", message) == (ord("H"), 0, len(anchors), 7)
    assert list(message[12:]) == [1, 2, 3] + [0] * (len(anchors) - 3)


def test_a_page_is_sent_anchors_conditions_and_the_tags_of_its_view(monkeypatch):
    live, gathered, columns = LiveSite("here", "mqtt://broker:1", SITE), Gathered(NatsAddress("nats://none")), Columns()
    live.attach(Wire(), SITE_ID)
    monkeypatch.setattr(gathered, "columns", {SITE_ID: columns}.get)
    app = make_app(Services(LiveSites(live), None, gathered=gathered), AccessRules())
    browser = TestClient(app, base_url="http://localhost:8080")
    columns.update(records_of([(5, 10**15, 1000, 1000)]), time.monotonic())
    columns.names.update({5: "t5", 6: ""})
    with browser.websocket_connect("ws://localhost:8080/live2") as socket:
        assert [chr(socket.receive_bytes()[0]) for _ in range(2)] == ["A", "H"]
        socket.send_text(json.dumps({"view": [0, 0, 10, 5], "px": [1000, 500], "named": [5, 6]}))
        names = socket.receive_bytes()
        assert struct.unpack_from("<BBH", names) == (ord("N"), 0, 1)
        assert json.loads(names[12:]) == {"5": "t5"}
        message = socket.receive_bytes()
        assert (chr(message[0]), struct.unpack_from("<I", message, 12)[0]) == ("P", 5)
        columns.update(records_of([(5, 10**15 + 1, 2000, 1000), (6, 10**15, 1, 1)]), time.monotonic())
        while struct.unpack_from("<H", message, 2)[0] != 2:
            message = socket.receive_bytes()
        assert gathered.pages == 1
        socket.close()
        while gathered.pages:
            time.sleep(0.01)
    with browser.websocket_connect("ws://localhost:8080/live") as socket:
        assert socket.receive_json()["live2"] is True


def test_a_server_without_a_gather_says_so():
    browser = browser_of(LiveSite("here", "mqtt://broker:1"))
    with browser.websocket_connect("ws://localhost:8080/live") as socket:
        assert socket.receive_json()["live2"] is False
    with pytest.raises(WebSocketDisconnect), browser.websocket_connect("ws://localhost:8080/live2"):
        pass
