"""The history's answers equal a plain computation over the same rows, file by file or not."""

import csv
import math
from collections import defaultdict
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from skyless.core.alert import Alert
from skyless.core.errors import SkylessError
from skyless.run.history import queries
from skyless.run.history.answers import Contact, Dwell, Span
from skyless.run.history.layout import (
    ASSET_COLUMNS,
    EVENT_COLUMNS,
    FIX_COLUMNS,
    NAME_COLUMNS,
    ZONE_COLUMNS,
    file_name,
    site_folder,
)
from skyless.run.history.queries import History, sites_in
from skyless.run.web import HistoryLimits
from support.parquet_files import arrow_table

pytestmark = pytest.mark.site

SITE, TAGS, FIXES = 7, 20, 5000
MIDNIGHT = datetime(2026, 11, 20, tzinfo=UTC).timestamp()
BEGIN = MIDNIGHT - 2000.0
SPAN = Span(BEGIN + 500.0, BEGIN + 4000.25)
EVENTS = [
    (-100.0, "enter", "tag1", "a"),  # before the range, never left
    (-90.0, "enter", "tag2", "a"),
    (600.0, "leave", "tag2", "a"),
    (1000.0, "enter", "tag2", "a"),
    (1100.0, "enter", "tag2", "a"),  # again, as after a restart
    (1300.0, "leave", "tag2", "a"),
    (1300.0, "enter", "tag2", "b"),
    (100.0, "leave", "tag3", "b"),  # that it entered is not known
    (2000.0, "enter", "tag3", "b"),
    (4500.0, "leave", "tag3", "b"),  # after the range
    (200.0, "enter", "tag4", "b"),
    (300.0, "leave", "tag4", "b"),  # all of it before
    (4100.0, "enter", "tag5", "a"),  # after the range
]
ALARMS = [
    (100.0, "alarm-raised", "r/tag1/1", "tag1", "one"),
    (200.0, "alarm-ended", "r/tag1/1", "tag1", ""),
    (300.0, "alarm-raised", "r/tag1/2", "tag1", "two"),
    (600.0, "alarm-ended", "r/tag1/2", "tag1", "two at the worst"),
    (700.0, "alarm-raised", "s/tag1+tag2/3", "tag1+tag2", "three"),
    (710.0, "alarm-acknowledged", "s/tag1+tag2/3", "tag1+tag2", "Ada"),
    (720.0, "alarm-acknowledged", "s/tag1+tag2/3", "tag1+tag2", "Bert"),
    (4200.0, "alarm-raised", "r/tag2/4", "tag2", "four"),
]


def made_rows(seed=1):
    """Fixes of walkers in a room, by the order of arrival, with silences and two tags that walk together."""
    draw = np.random.default_rng(seed)
    t = np.repeat(np.arange(FIXES) * 1.0, TAGS).reshape(FIXES, TAGS) + draw.uniform(0.0, 0.4, (FIXES, TAGS))
    walk = np.cumsum(draw.normal(0.0, 0.3, (FIXES, TAGS, 2)), axis=0) + draw.uniform(-5.0, 15.0, (TAGS, 2))
    walk[:, 1] = walk[:, 0] + draw.normal(0.0, 1.0, (FIXES, 2))
    kept = (np.sin(np.arange(FIXES) / 90.0)[:, None] + draw.uniform(0.0, 0.2, (FIXES, TAGS)) < 1.0).ravel()
    tag = np.tile(np.arange(1, TAGS + 1), FIXES)[kept]
    flags = draw.integers(0, 6, len(tag)) | 64
    hpl = np.where(draw.uniform(size=len(tag)) < 0.5, 65535, 120)
    mm = np.rint(1000.0 * walk.reshape(-1, 2)[kept]).astype(int)
    ms = np.rint(1000.0 * (BEGIN + t.ravel()[kept])).astype(int)
    return {"tag": tag, "t": ms, "x_mm": mm[:, 0], "y_mm": mm[:, 1], "z_mm": np.full(len(tag), 1200),
            "std_mm": draw.integers(20, 200, len(tag)), "hpl_cm": hpl, "flags": flags}  # fmt: skip


def write_fixes(site, rows, first, last):
    """A file of rows by their numbers in the order of arrival, which begin with 1."""
    part = {name: values[first - 1 : last] for name, values in rows.items()}
    order = np.lexsort((part["t"], part["tag"]))
    day = datetime.fromtimestamp(part["t"][0] / 1000, UTC).date()
    folder = site / f"day={day}"
    folder.mkdir(parents=True, exist_ok=True)
    fixes = arrow_table(FIX_COLUMNS, {name: values[order] for name, values in part.items()})
    parquet.write_table(fixes, folder / file_name(first, last), row_group_size=7000)


def write_others(site):
    names = [*((k, f"tag{k}", 0) for k in range(1, TAGS)), (TAGS, "old", 0), (TAGS, "renamed", 5)]
    parquet.write_table(arrow_table(NAME_COLUMNS, dict(zip(NAME_COLUMNS, zip(*names, strict=True), strict=True))),
                        site / "names.parquet")  # fmt: skip
    assets = {"tag": ["tag3", "tag4", "tag5", "tag6", "tag7", "gone"],
              "name": ["Forklift", "Twin", "Twin", "tag3", "", "Forklift"]}  # fmt: skip
    parquet.write_table(arrow_table(ASSET_COLUMNS, assets), site / "assets.parquet")
    zones = {
        "zone": ["a", "b", "empty"],
        "name": ["Hall", "", "Void"],
        "corners_m": ["[[0, 0], [4, 0], [4, 4]]", None, "[]"],
    }
    parquet.write_table(arrow_table(ZONE_COLUMNS, zones), site / "zones.parquet")
    rows = [(round(1000 * (BEGIN + s)), kind, tag, zone, None, None, "") for s, kind, tag, zone in EVENTS]
    rows += [(round(1000 * (BEGIN + s)), kind, None, None, about, one, text) for s, kind, one, about, text in ALARMS]
    folder = site / "events" / "day=2026-11-20"
    folder.mkdir(parents=True)
    for first, part in ((1, rows[:9]), (10, rows[9:])):
        events = arrow_table(EVENT_COLUMNS, dict(zip(EVENT_COLUMNS, zip(*sorted(part), strict=True), strict=True)))
        parquet.write_table(events, folder / file_name(first, first + len(part) - 1))


@pytest.fixture(scope="module")
def rows():
    return made_rows()


@pytest.fixture(scope="module")
def history(tmp_path_factory, rows):
    folder = tmp_path_factory.mktemp("history")
    site, count = site_folder(folder, SITE), len(rows["t"])
    for first in range(1, count + 1, 20_000):
        write_fixes(site, rows, first, min(first + 19_999, count))
    write_fixes(site, rows, 20_001, 30_000)  # joined into a larger file since
    write_others(site)
    return History(folder, SITE)


@pytest.fixture(scope="module")
def within(rows):
    """The rows in the range, by tag and time."""
    keep = (rows["t"] >= 1000 * SPAN.from_unix_s) & (rows["t"] < 1000 * SPAN.to_unix_s)
    part = {name: values[keep] for name, values in rows.items()}
    order = np.lexsort((part["t"], part["tag"]))
    return {name: values[order] for name, values in part.items()}


def plain_gap_ms(t):
    """The silence after which a tag with fixes at these times in ms would be gone."""
    gaps_ms = [one for one in np.diff(t) if one <= 900_000]
    long_s = [round(one / 1000) for one in gaps_ms if one > 1500]

    def is_usual(gap_s):
        longer_s = [one for one in long_s if one >= gap_s]
        return len(longer_s) >= 3 and sum(longer_s) >= 0.15 * sum(gaps_ms) / 1000

    return 1000 * min(max(10, 4 * max(filter(is_usual, {*long_s}), default=0)), 900)


def test_tags_and_zones(history):
    assert history.tags() == tuple(sorted([*(f"tag{k}" for k in range(1, TAGS)), "renamed"]))
    assert history.zones()["a"] == ("Hall", ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0)))
    assert history.zones()["b"] == ("b", ())
    assert sites_in(history.folder) == (SITE,)


def test_known_until_the_newest_row(history, rows):
    assert history.known_until_unix_s() == pytest.approx(rows["t"].max() / 1000)


def test_an_import_of_an_older_recording_does_not_hide_the_newest_row(tmp_path, rows):
    site, earlier = site_folder(tmp_path, 1), dict(rows, t=rows["t"] - 10 * 86_400_000)
    write_fixes(site, rows, 1, 100)
    for first in (101, 201, 301):
        write_fixes(site, earlier, first, first + 99)
    assert History(tmp_path, 1).known_until_unix_s() == pytest.approx(rows["t"][:100].max() / 1000)


def test_a_track_is_all_fixes_of_the_tag(history, within):
    track = history.track("tag3", SPAN, most_points=10_000)
    own = {name: values[within["tag"] == 3] for name, values in within.items()}
    assert track.fixes == len(track.points) == len(own["t"])
    assert [point.unix_s for point in track.points] == pytest.approx((own["t"] / 1000).tolist())
    assert [(point.x_m, point.y_m, point.z_m, point.std_m) for point in track.points] == [
        pytest.approx((x / 1000, y / 1000, 1.2, std / 1000))
        for x, y, std in zip(own["x_mm"], own["y_mm"], own["std_mm"], strict=True)
    ]
    assert [point.hpl_m for point in track.points] == [None if one == 65535 else 1.2 for one in own["hpl_cm"]]
    alerts = [None, *map(str, Alert)]
    assert [point.alert for point in track.points] == [alerts[flags & 7] if flags & 7 < len(alerts) else None
                                                       for flags in own["flags"]]  # fmt: skip
    assert track.length_m == pytest.approx(plain_length(own), rel=1e-9)


def test_tags_are_found_by_the_names_of_their_assets(history):
    assert history.track("forklift", SPAN, 100) == history.track("tag3", SPAN, 100)
    assert history.heatmap(SPAN, 0.3, ("Forklift",)) == history.heatmap(SPAN, 0.3, ("tag3",))
    assert history.contacts("Forklift", SPAN) == history.contacts("tag3", SPAN)
    assert history.dwell(SPAN, ("Forklift",)) == history.dwell(SPAN, ("tag3",)) != ()


def plain_length(own):
    total, at, gap_ms = 0.0, None, plain_gap_ms(own["t"])
    for k in range(len(own["t"])):
        here = np.array([own["x_mm"][k], own["y_mm"][k]])
        if at is None or own["t"][k] - own["t"][k - 1] > gap_ms:
            at = here
        elif np.hypot(*(here - at)) >= max(250, 3 * own["std_mm"][k]):
            total, at = total + np.hypot(*(here - at)), here
    return total / 1000


@pytest.mark.parametrize("most", [2, 3, 100, 2999])
def test_a_thinned_track_keeps_its_ends_and_its_length(history, most):
    whole, thin = history.track("tag3", SPAN, 10_000), history.track("tag3", SPAN, most)
    assert len(thin.points) <= most
    assert (thin.points[0], thin.points[-1]) == (whole.points[0], whole.points[-1])
    assert set(thin.points) <= set(whole.points)
    assert (thin.fixes, thin.length_m) == (whole.fixes, whole.length_m)
    if most >= 100:
        for before, after in pairwise(whole.points):
            assert after.unix_s - before.unix_s <= whole.gap_s or {before, after} <= set(thin.points)


@pytest.mark.parametrize("tags", [(), ("tag3",), ("tag3", "renamed")])
def test_a_heatmap_is_the_time_until_the_next_fix(history, within, tags):
    heatmap = history.heatmap(SPAN, 0.3, tags)
    numbers = {"tag3": 3, "renamed": TAGS}
    seconds = defaultdict(float)
    for tag in [numbers[one] for one in tags] or range(1, TAGS + 1):
        own = within["tag"] == tag
        t, cells = within["t"][own], np.column_stack([within["x_mm"][own], within["y_mm"][own]]) // 300
        gap_ms = plain_gap_ms(t)
        for k in range(len(t) - 1):
            seconds[tuple(cells[k].tolist())] += min(t[k + 1] - t[k], gap_ms) / 1000
    found = np.array(heatmap.seconds).reshape(heatmap.rows, heatmap.columns)
    x0, y0 = round(heatmap.x0_m / 0.3), round(heatmap.y0_m / 0.3)
    given_ = {(x0 + int(k), y0 + int(j)): found[j, k] for j, k in zip(*np.nonzero(found), strict=True)}
    assert given_ == pytest.approx({cell: s for cell, s in seconds.items() if s > 0})
    assert heatmap.tags == (len(tags) or TAGS)
    assert heatmap.cell_m == 0.3


def test_a_wild_fix_makes_no_grid_of_a_billion_cells(tmp_path, rows):
    site = site_folder(tmp_path, 1)
    wild = {name: values.copy() for name, values in rows.items()}
    wild["x_mm"][50_000], wild["y_mm"][50_010] = 2_000_000_000, -2_000_000_000
    write_fixes(site, wild, 1, len(rows["t"]))
    parquet.write_table(arrow_table(NAME_COLUMNS, {"tag": [1], "name": ["tag1"], "since": [0]}), site / "names.parquet")
    history, span = History(tmp_path, 1), Span(BEGIN, BEGIN + 5000.0)
    assert len(history.contacts("tag1", span)) > 0
    heatmap = history.heatmap(span, 0.25)
    assert sum(heatmap.seconds) > 0.5 * TAGS * FIXES
    assert heatmap.columns * heatmap.rows < 1_000_000


def test_dwell_counts_the_part_of_a_visit_in_the_range(history):
    begin, end = SPAN.from_unix_s, SPAN.to_unix_s
    expected = (
        Dwell("tag1", "a", "Hall", 1, end - begin, begin, end),
        Dwell("tag2", "a", "Hall", 2, 400.0, begin, BEGIN + 1300.0),
        Dwell("tag2", "b", "b", 1, end - BEGIN - 1300.0, BEGIN + 1300.0, end),
        Dwell("tag3", "b", "b", 1, end - BEGIN - 2000.0, BEGIN + 2000.0, end),
    )
    assert history.dwell(SPAN) == expected
    assert history.dwell(SPAN, ("tag2", "tag3")) == expected[1:]
    assert history.dwell(SPAN, zone="b") == expected[2:]
    assert history.dwell(SPAN, ("tag2",), "a") == expected[1:2]
    assert history.dwell(SPAN, zone="empty") == ()


def test_an_open_visit_ends_where_the_history_does(history, rows):
    (found,) = history.dwell(Span(BEGIN + 4900.0, BEGIN + 90_000.0), ("tag1",))
    assert found.last_unix_s == pytest.approx(rows["t"].max() / 1000)
    assert history.dwell(Span(BEGIN + 50_000.0, BEGIN + 90_000.0)) == ()


@pytest.mark.parametrize("distance_m", [0.5, 2.0])
def test_contacts_are_pairs_of_the_same_second(history, within, distance_m):
    found = history.contacts("tag1", SPAN, distance_m)
    positions = defaultdict(dict)
    for tag, t, x, y in zip(*(within[name].tolist() for name in ("tag", "t", "x_mm", "y_mm")), strict=True):
        positions[t // 1000].setdefault(tag, []).append((x, y))
    near = defaultdict(dict)
    for second, tags in positions.items():
        for tag, places in tags.items():
            least = min((math.dist(a, b) for a in places for b in tags.get(1, ())[:1]), default=math.inf)
            if tag != 1 and least <= 1000.0 * distance_m:
                near[tag][second] = least / 1000.0
    expected = []
    for tag, seconds in near.items():
        other = "renamed" if tag == TAGS else f"tag{tag}"
        first = [second for second in seconds if not {*range(second - 6, second)} & {*seconds}]
        for begin, following in pairwise([*sorted(first), 10**12]):
            of_contact = [second for second in seconds if begin <= second < following]
            least = min(seconds[second] for second in of_contact)
            expected.append(Contact("tag1", other, begin, min(max(of_contact) + 1, SPAN.to_unix_s), least))
    expected.sort(key=lambda one: (one.begin_unix_s, one.other))
    assert len({one.other for one in expected}) > 1
    assert [(one.other, one.begin_unix_s, one.end_unix_s) for one in found] == [
        (one.other, one.begin_unix_s, one.end_unix_s) for one in expected
    ]
    assert [one.least_m for one in found] == pytest.approx([one.least_m for one in expected])


@pytest.mark.parametrize(
    "spoilt", [lambda data: b"", lambda data: data[:-20], lambda data: data[: len(data) // 2], bytes]
)
def test_a_damaged_file_is_named_and_no_traceback(tmp_path, rows, spoilt):
    """Empty, cut off, half, and a sound file whose middle was overwritten."""
    site = site_folder(tmp_path, 1)
    write_fixes(site, {name: values[:2000] for name, values in rows.items()}, 1, 2000)
    parquet.write_table(arrow_table(NAME_COLUMNS, {"tag": [1], "name": ["tag1"], "since": [0]}), site / "names.parquet")
    (file,) = site.glob("day=*/*.parquet")
    data = file.read_bytes()
    file.write_bytes(
        spoilt(data) if spoilt is not bytes else data[:100] + bytes(len(data) // 2) + data[100 + len(data) // 2 :]
    )
    history, span = History(tmp_path, 1), Span(BEGIN - 10.0, BEGIN + 5000.0)
    for ask in (
        lambda: history.heatmap(span),
        lambda: history.track("tag1", span),
        lambda: history.contacts("tag1", span),
        lambda: history.sql("FROM fixes", span),
    ):
        with pytest.raises(SkylessError, match=f"{file.name}.* cannot be read"):
            ask()


def test_an_empty_range(history):
    empty = Span(BEGIN - 9e6, BEGIN - 8e6)
    assert history.track("tag1", empty).points == ()
    assert history.heatmap(empty).seconds == ()
    assert history.contacts("tag1", empty) == ()
    assert history.contacts("tag1", SPAN, 0.01) == ()
    assert history.dwell(empty) == ()
    assert history.sql("FROM fixes", empty) == history.sql("FROM events", empty) == []


@pytest.mark.parametrize(
    ("ask", "error"),
    [
        (lambda h: h.track("tag0", SPAN), "has no tag 'tag0'; it has renamed, tag1, tag10, tag11, tag12 and 15 more"),
        (lambda h: h.track("old", SPAN), "has no tag 'old'"),
        (lambda h: h.track("twin", SPAN), "'twin' is the name of tag4 and tag5; it should be one of these"),
        (lambda h: h.track("", SPAN), "has no tag ''"),
        (lambda h: h.track("' OR 1=1 --", SPAN), "has no tag"),
        (lambda h: h.dwell(SPAN, ("x",)), "has no tag 'x'"),
        (lambda h: h.dwell(SPAN, zone="a' OR 'a'='a"), "has no zone .*; it has a, b, empty"),
        (lambda h: h.heatmap(SPAN, 0.0), "the cells' side is 0.0"),
        (lambda h: h.heatmap(SPAN, 0.01), "too many; choose larger"),
        (lambda h: h.contacts("tag1", SPAN, 1e6), "the distance is 1000000.0"),
        (lambda h: h.write("FROM fixes", SPAN, h.folder / "x.xlsx"), "it should end with .csv or .parquet"),
        (lambda h: History(h.folder, 8), "no history of site 8; it holds site 7"),
        (lambda h: History(h.folder / "none", 8), "skyless history run"),
    ],
)
def test_what_cannot_be_answered_is_said(history, ask, error):
    with pytest.raises(SkylessError, match=error):
        ask(history)


@pytest.mark.parametrize(
    ("limits", "ask", "error"),
    [
        ({"cells": 10}, lambda h: h.heatmap(SPAN), "cells of 0.25 m are too many; choose ones of"),
        ({"contacts": 1}, lambda h: h.contacts("tag1", SPAN), "choose a shorter range or a smaller distance"),
        ({"rows": 3}, lambda h: h.dwell(SPAN), "more than 3 rows; choose a shorter range, a tag or a zone"),
        ({"rows": 1}, lambda h: h.sql("FROM zones", SPAN), "more than 1 rows; --write takes all, and LIMIT some"),
        ({"points": 9}, lambda h: h.track("tag1", SPAN, 10), "the number of points is 10"),
    ],
)
def test_what_is_too_much_is_refused_with_what_would_do(history, monkeypatch, limits, ask, error):
    monkeypatch.setattr(queries, "LIMITS", HistoryLimits(**limits))
    with pytest.raises(SkylessError, match=error):
        ask(history)


def test_contacts_are_the_same_in_parts(history, monkeypatch):
    whole = history.contacts("tag1", SPAN)
    monkeypatch.setattr(queries, "_PART_S", 100.0)
    assert history.contacts("tag1", SPAN) == whole != ()


def test_a_file_that_is_replaced_while_it_is_read(history, monkeypatch):
    """Its rows are found in the larger one at the second try; a file that is no Parquet is an error."""
    files, whole = history._files, history.track("tag1", SPAN)
    gone = [[Path("/gone/000000000001-000000000002.parquet")]]
    monkeypatch.setattr(history, "_files", lambda span: gone.pop() if gone else files(span))
    assert history.track("tag1", SPAN) == whole
    gone[:] = [[Path("/gone")]] * 3
    with pytest.raises(SkylessError, match="the history cannot be read"):
        history.heatmap(SPAN)


@pytest.fixture(params=[1_000_000, 50], ids=["one file", "many files"])
def sleepers(request, tmp_path):
    """An hour of tags that send rarely, next to each other or on a way, and of one that sends often for 10 minutes."""
    site, draw = site_folder(tmp_path, 2), np.random.default_rng(3)
    intervals_s = {"minute": 60.0, "ten": 10.0, "bursts": 40.0, "five": 300.0, "often": 0.5}
    columns = []
    for number, (name, interval_s) in enumerate(intervals_s.items(), 1):
        s = np.arange(2.0, 3599.0, interval_s)
        if name == "bursts":
            s = np.concatenate([s + 0.1 * k for k in range(20)])
        if name == "often":
            s = s[(s >= 1200.0) & (s < 1800.0)]
        s += draw.uniform(0.0, min(0.05 * interval_s, 1.0), len(s))
        x_m = s / 20.0 if name == "ten" else np.full(len(s), 1000.0 if name == "five" else number % 2)
        columns.append(np.array([np.full(len(s), number), 1000 * s, 1000 * x_m, np.zeros(len(s))]).round().astype(int))
    tag, ms, x_mm, y_mm = np.concatenate(columns, axis=1)[:, np.argsort(np.concatenate(columns, axis=1)[1])]
    rows = {"tag": tag, "t": round(1000 * MIDNIGHT) + ms, "x_mm": x_mm, "y_mm": y_mm}
    rows |= {name: np.full(len(tag), 10) for name in FIX_COLUMNS if name not in rows}
    for first in range(1, len(tag) + 1, request.param):
        write_fixes(site, rows, first, min(first + request.param - 1, len(tag)))
    names = {"tag": [*range(1, 6)], "name": [*intervals_s], "since": [0] * 5}
    parquet.write_table(arrow_table(NAME_COLUMNS, names), site / "names.parquet")
    return History(tmp_path, 2)


def test_fixes_of_tags_that_send_rarely_count_until_the_next_one(sleepers):
    span = Span(MIDNIGHT, MIDNIGHT + 3600.0)
    for tag in ("minute", "ten", "bursts", "five", "often"):
        track = sleepers.track(tag, span)
        seconds = sum(sleepers.heatmap(span, tags=(tag,)).seconds)
        assert seconds == pytest.approx(track.points[-1].unix_s - track.points[0].unix_s)
        assert seconds > {"five": 3290.0, "often": 598.0}.get(tag, 3530.0)
        assert track.gap_s == {"five": 900.0, "often": 10.0}.get(tag, track.gap_s)
        assert track.length_m == pytest.approx(179.0 if tag == "ten" else 0.0, abs=3.0)


def test_contacts_of_tags_that_send_rarely(sleepers):
    span = Span(MIDNIGHT, MIDNIGHT + 3600.0)
    for one, other, begin_s, end_s, known_s in (
        ("minute", "bursts", 0, 3600, 60),
        ("bursts", "minute", 0, 3600, 60),
        ("minute", "often", 1200, 1800, 60),
        ("often", "bursts", 1200, 1800, 60),
        ("bursts", "ten", 0, 30, 60),
    ):
        (contact,) = [found for found in sleepers.contacts(one, span, 2.0) if found.other == other]
        assert contact.begin_unix_s - MIDNIGHT == pytest.approx(begin_s, abs=known_s)
        assert contact.end_unix_s - MIDNIGHT == pytest.approx(end_s, abs=known_s)
    assert not any("five" in (found.tag, found.other) for found in sleepers.contacts("minute", span, 2.0))


def test_sql_sees_every_fix_of_the_range(history, within, tmp_path):
    files = tmp_path / "fixes.csv", tmp_path / "fixes.parquet"
    query = "SELECT * FROM fixes ORDER BY tag, unix_s -- all of them"
    assert [history.write(query, SPAN, file) for file in files] == [len(within["t"])] * 2
    whole = parquet.read_table(files[1]).to_pylist()
    assert sorted(one["x_m"] for one in whole) == pytest.approx(sorted((within["x_mm"] / 1000).tolist()))
    assert {one["hpl_m"] for one in whole} == {None, 1.2}
    assert {one["tag"] for one in whole} == {"renamed", *(f"tag{k}" for k in range(1, TAGS))}
    with files[0].open(newline="") as file:
        text = list(csv.DictReader(file))
    assert [float(one["y_m"]) for one in text] == [one["y_m"] for one in whole]
    assert text[0]["time_utc"][:10] == "2026-11-19"
    own = history.sql("SELECT unix_s, alert, simulated FROM fixes WHERE tag = 'tag3';", SPAN)
    assert sorted(one["unix_s"] for one in own) == (within["t"][within["tag"] == 3] / 1000).tolist()


def test_sql_answers_what_the_questions_do_not(history):
    """Alarms that overlap a range, and how full a zone was."""
    alarms = f"""
        SELECT alarm, min(unix_s) FILTER (kind = 'alarm-raised') AS raised,
            max(unix_s) FILTER (kind = 'alarm-ended') AS ended
        FROM events WHERE alarm NOT NULL GROUP BY alarm HAVING coalesce(ended, 1e10) > {SPAN.from_unix_s}
        ORDER BY raised
    """
    found = history.sql(alarms, Span(0.0, SPAN.to_unix_s))
    assert [(one["alarm"], one["ended"]) for one in found] == [("r/tag1/2", BEGIN + 600.0), ("s/tag1+tag2/3", None)]
    inside = """
        SELECT zone, sum(CASE kind WHEN 'enter' THEN 1 ELSE -1 END) OVER (PARTITION BY zone ORDER BY unix_s) AS tags
        FROM events JOIN zones USING (zone) WHERE kind IN ('enter', 'leave') AND tag = 'tag4' ORDER BY unix_s
    """
    assert [(one["zone"], one["tags"]) for one in history.sql(inside, Span(0.0, 1e10))] == [("b", 1), ("b", 0)]
    assert {"tag": "tag3", "name": "Forklift"} in history.sql("FROM assets", SPAN)


@pytest.mark.parametrize(
    ("query", "error"),
    [
        ("SELEC 1", 'cannot be answered: Parser Error: syntax error at or near "SELEC"'),
        ("SELECT nothing FROM fixes", "cannot be answered: Binder Error: .*nothing"),
        ("", "the SQL is ''; it should be one SELECT"),
        *(
            (query, "it should be one SELECT")
            for query in (
                "SELECT 1; SELECT 2",
                "COPY fixes TO '$f.csv'",
                "COPY fixes TO '$history'",
                "ATTACH '$f.db'",
                "INSTALL httpfs",
                "LOAD httpfs",
                "PRAGMA version",
                "SET memory_limit = '9GB'",
                "SET enable_external_access = true",
                "CALL enable_logging()",
                "CREATE TABLE t AS SELECT 1",
                "EXPORT DATABASE '$f'",
            )
        ),
        *(
            (f"SELECT * FROM {one}", "Permission Error|Parser Error|does not exist|has been locked")
            for one in (
                "read_csv('/etc/passwd')",
                "read_text('/etc/passwd')",
                "'/etc/passwd.csv'",
                "glob('/etc/*')",
                "read_parquet('$other')",
                "read_parquet('https://example.org/a.parquet')",
                "query('COPY fixes TO ''$f.csv''')",
                "enable_logging(storage = 'file', storage_path = '$f')",
                "history",
            )
        ),
    ],
)
def test_sql_reads_the_history_and_nothing_else(history, tmp_path, query, error):
    other = tmp_path / "other.parquet"
    parquet.write_table(pa.table({"a": [1]}), other)
    before = {file: file.stat().st_mtime_ns for file in history.folder.rglob("*")}
    own = next(iter(history._files(SPAN)))
    query = query.replace("$f", f"{tmp_path}/f").replace("$other", str(other)).replace("$history", str(own))
    for ask in (lambda: history.sql(query, SPAN), lambda: history.write(query, SPAN, tmp_path / "out.csv")):
        with pytest.raises(SkylessError, match=error) as raised:
            ask()
        assert "\n" not in str(raised.value)
    assert {*tmp_path.iterdir()} == {other}
    assert {file: file.stat().st_mtime_ns for file in history.folder.rglob("*")} == before
