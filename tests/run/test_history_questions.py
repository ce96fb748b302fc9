"""The history's answers equal a plain computation over the same rows, file by file or not."""

import csv
import math
import re
from bisect import bisect_left, bisect_right
from collections import defaultdict
from datetime import UTC, datetime
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from skyless.core.alert import Alert
from skyless.core.errors import SkylessError
from skyless.run.history import queries, scans
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
DOCUMENT = Path(__file__).parents[2] / "docs" / "history.md"
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


def plain_counts_ms(t):
    """For how long each of a tag's fixes at these times in ms counts; the last one does not."""
    gaps = [b - a for a, b in pairwise(t)]
    known = sum(gap for gap in gaps if gap <= 900_000)

    def is_usual(k):
        if 1.1 * gaps[k] > known:
            return True
        bound = next(bound for bound in (10_000 * 2**n for n in range(7)) if gaps[k] <= 2 * bound)
        similar = [n for n, gap in enumerate(gaps) if 0.4 * bound <= gap <= 900_000]
        before, after = [n for n in similar if n < k], [n for n in similar if n > k]
        apart = [t[k] - t[n + 1] for n in before[-1:]] + [t[n] - t[k + 1] for n in after[:1]]
        return min(apart, default=math.inf) < gaps[k]

    usual = {k for k, gap in enumerate(gaps) if 10_000 < gap <= 900_000 and is_usual(k)}
    return [*(gap if k in usual else min(gap, 10_000) for k, gap in enumerate(gaps)), 0]


def plain_contacts(within, own, other, distance_mm):
    """Begin, end and least distance of contacts, fix by fix."""
    fixes = {}
    for tag in (own, other):
        rows = [within[name][within["tag"] == tag].tolist() for name in ("t", "x_mm", "y_mm")]
        fixes[tag] = [*zip(*rows, [a + b for a, b in zip(rows[0], plain_counts_ms(rows[0]), strict=True)], strict=True)]
    mine = []
    for _, fixes_of_second in groupby(fixes[own], key=lambda fix: fix[0] // 1000):
        first, *more = fixes_of_second
        mine.append([*first[:3], max(fix[3] for fix in (first, *more))])
    for fix, following in pairwise(mine):
        fix[3] = min(fix[3], following[0])
    times, found = [fix[0] for fix in mine], []
    for t, x, y, end in fixes[other]:
        at = bisect_right(times, t)
        last = bisect_left(times, end) if end - t > 1500 else at
        for own_t, own_x, own_y, own_end in mine[max(at - 1, 0) : last]:
            apart = math.hypot(x - own_x, y - own_y)
            if max(t, own_t) <= min(end, own_end) and apart <= distance_mm:
                found.append((max(t, own_t), min(end, own_end), apart))
    contacts = []
    for begin, end, apart in sorted(found):
        if contacts and begin <= contacts[-1][1] + 5000:
            contacts[-1] = contacts[-1][0], max(contacts[-1][1], end), min(contacts[-1][2], apart)
        else:
            contacts.append((begin, end, apart))
    return [tuple(value / 1000 for value in contact) for contact in contacts]


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
    total, at, counts_ms = 0.0, None, plain_counts_ms(own["t"].tolist())
    for k in range(len(own["t"])):
        here = np.array([own["x_mm"][k], own["y_mm"][k]])
        if at is None or own["t"][k] - own["t"][k - 1] > counts_ms[k - 1]:
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
        for cell, counts_ms in zip(cells.tolist(), plain_counts_ms(t.tolist()), strict=True):
            seconds[tuple(cell)] += counts_ms / 1000
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
def test_contacts_are_times_in_which_the_newest_fixes_are_near(history, within, distance_m):
    found = history.contacts("tag1", SPAN, distance_m)
    expected = [
        Contact("tag1", "renamed" if tag == TAGS else f"tag{tag}", *contact)
        for tag in range(2, TAGS + 1)
        for contact in plain_contacts(within, 1, tag, 1000 * distance_m)
    ]
    expected.sort(key=lambda one: (one.begin_unix_s, one.other))
    assert len({one.other for one in expected}) > 1
    assert [(one.other, one.begin_unix_s, one.end_unix_s) for one in found] == [
        (one.other, pytest.approx(one.begin_unix_s), pytest.approx(one.end_unix_s)) for one in expected
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
    for module in (queries, scans):
        monkeypatch.setattr(module, "LIMITS", HistoryLimits(**limits))
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


HOUR = Span(MIDNIGHT, MIDNIGHT + 3600.0)


def history_of(folder, tags, rows_of_file=1_000_000, thinned=()):
    """A history of one site with the fixes of tags, times in s after midnight and x in m, in the order of arrival."""
    site = site_folder(folder, 2)
    columns = [
        np.array([np.full(len(s), number), 1000 * np.asarray(s), 1000 * np.broadcast_to(x_m, len(s))])
        for number, (s, x_m) in enumerate(tags.values(), 1)
    ]
    tag, ms, x_mm = np.concatenate(columns, axis=1).round().astype(int)
    order = np.argsort(ms, kind="stable") if rows_of_file > 0 else np.arange(len(ms))
    rows = {"tag": tag[order], "t": round(1000 * MIDNIGHT) + ms[order], "x_mm": x_mm[order]}
    rows |= {name: np.full(len(tag), 10) for name in FIX_COLUMNS if name not in rows}
    for first in range(1, len(tag) + 1, abs(rows_of_file)):
        write_fixes(site, rows, first, min(first + abs(rows_of_file) - 1, len(tag)))
    for file in site.glob("day=*/*.parquet") if thinned else ():
        marked = parquet.ParquetFile(file).read().replace_schema_metadata({b"skyless_thinned": b"yes"})
        parquet.write_table(marked, file)
    names = {"tag": [*range(1, len(tags) + 1)], "name": [*tags], "since": [0] * len(tags)}
    parquet.write_table(arrow_table(NAME_COLUMNS, names), site / "names.parquet")
    return History(folder, 2)


def every(interval_s, first_s=0.0, end_s=3600.0):
    return np.arange(first_s, end_s, interval_s)


def seconds_of(history, tag, span=HOUR):
    return sum(history.heatmap(span, tags=(tag,)).seconds)


@pytest.mark.parametrize("rows_of_file", [1_000_000, 50])
def test_fixes_count_until_the_next_one_also_of_tags_that_send_rarely(tmp_path, rows_of_file):
    bursts = np.sort(np.concatenate([every(40.0) + 0.1 * k for k in range(20)]))
    lossy = every(10.0)[np.random.default_rng(3).uniform(size=360) < 0.8]
    tags = {f"{one:g} s": every(one) for one in (5.0, 10.0, 60.0, 300.0)} | {"bursts": bursts, "lossy": lossy}
    tags["slow bursts"] = np.sort(np.concatenate([every(81.0) + 3.0 * k for k in range(8)]))
    tags["sleeps, then walks"] = np.concatenate([every(300.0, end_s=1800.0), every(1.0, 1800.0)])
    history = history_of(tmp_path, {name: (s, 0.05 * s) for name, s in tags.items()}, rows_of_file)
    for tag, s in tags.items():
        assert seconds_of(history, tag) == pytest.approx(s[-1] - s[0]), tag
        assert history.track(tag, HOUR).length_m == pytest.approx(0.05 * (s[-1] - s[0]), abs=0.3), tag
    assert seconds_of(history, "300 s", Span(MIDNIGHT, MIDNIGHT + 600.0)) == pytest.approx(300.0)


def test_an_absence_does_not_count(tmp_path):
    present = [every(1.0, 0.0, 700.0), every(1.0, 1000.0, 1700.0), every(1.0, 2000.0, 3200.0), every(1.0, 3500.0)]
    night = np.array([0.0, 1.0, 2.0, 1000.0, 1001.0])
    once = np.concatenate([every(1.0, 0.0, 600.0), every(1.0, 1320.0, 1380.0)])
    history = history_of(
        tmp_path, {"breaks": (np.concatenate(present), 0.0), "gone": (night, 0.0), "once": (once, 0.0)}
    )
    assert seconds_of(history, "breaks") == pytest.approx(3600.0 - 4 - 3 * 300.0 + 3 * 10.0, abs=1.0)
    assert seconds_of(history, "gone") == pytest.approx(3.0 + 10.0)
    assert seconds_of(history, "once") == pytest.approx(599.0 + 10.0 + 59.0)
    assert history.track("breaks", HOUR).gap_s == 10.0


def test_fixes_that_arrive_late_or_by_turns_in_files_count_once(tmp_path):
    own, late = np.concatenate([every(1.0, 0.0, 1000.0), every(1.0, 1100.0, 2000.0)]), every(1.0, 1000.0, 1100.0)
    history = history_of(tmp_path, {"late": (np.concatenate([own, late]), 0.0)}, -len(own))
    assert seconds_of(history, "late") == pytest.approx(1999.0)
    turns = every(10.0)
    history = history_of(tmp_path / "2", {"turns": (np.concatenate([turns[::2], turns[1::2]]), 0.0)}, -180)
    assert seconds_of(history, "turns") == pytest.approx(3590.0)


def test_in_thinned_files_a_fix_counts_for_a_minute(tmp_path):
    s = np.concatenate([every(10.0, 0.0, 1000.0), [1045.0], every(10.0, 1055.0, 2000.0)])
    history = history_of(tmp_path, {"mostly moves": (s, 0.0)}, thinned=True)
    assert seconds_of(history, "mostly moves") == pytest.approx(s[-1])


@pytest.mark.parametrize("rows_of_file", [1_000_000, 50])
def test_contacts_of_tags_that_send_rarely_are_found_from_both(tmp_path, rows_of_file):
    tags = {
        "rests, 60": (every(60.0, 2.0), 0.0),
        "rests, 10": (every(10.0, 5.0), 1.0),
        "rests, 300": (every(300.0, 7.0), 50.0),
        "visits": (every(1.0, 1000.0, 1600.0), 0.5),
        "passes": (every(0.5), every(0.5) - 1755.0),
        "looks in": (every(1.0), np.where(every(1.0) % 12 == 1, -20.0, -50.0)),
        "rests, 2.4": (every(2.4), -20.0),
    }
    history = history_of(tmp_path, tags, rows_of_file)
    for one, other, begin_s, end_s in (
        ("rests, 60", "rests, 10", 5.0, 3542.0),
        ("rests, 60", "visits", 1000.0, 1599.0),
        ("rests, 10", "visits", 1000.0, 1599.0),
        ("rests, 300", "passes", 1803.0, 1807.5),
        ("rests, 2.4", "looks in", 1.0, 2.0),
    ):
        for own, seen in ((one, other), (other, one)):
            contact = next(found for found in history.contacts(own, HOUR, 2.0) if found.other == seen)
            times_s = contact.begin_unix_s - MIDNIGHT, contact.end_unix_s - MIDNIGHT
            assert times_s == pytest.approx((begin_s, end_s), abs=1.01), (own, seen)
    assert {found.other for found in history.contacts("rests, 300", HOUR, 2.0)} == {"passes"}


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
    """Alarms that overlap a range, and the document's examples, such as how full a zone was."""
    alarms = f"""
        SELECT alarm, min(unix_s) FILTER (kind = 'alarm-raised') AS raised,
            max(unix_s) FILTER (kind = 'alarm-ended') AS ended
        FROM events WHERE alarm NOT NULL GROUP BY alarm HAVING coalesce(ended, 1e10) > {SPAN.from_unix_s}
        ORDER BY raised
    """
    found = history.sql(alarms, Span(0.0, SPAN.to_unix_s))
    assert [(one["alarm"], one["ended"]) for one in found] == [("r/tag1/2", BEGIN + 600.0), ("s/tag1+tag2/3", None)]
    stated = re.findall(r'^skyless history sql "(.*?)"', DOCUMENT.read_text(), re.MULTILINE | re.DOTALL)
    answers = [history.sql(query, Span(0.0, 1e10)) for query in stated]
    (most,) = [rows for query, rows in zip(stated, answers, strict=True) if "AS most" in query]
    hours = [(one["name"], one["hour_utc"].hour, one["most"]) for one in most]
    assert hours == [("", 23, 1), ("", 0, 2), ("Hall", 23, 2), ("Hall", 0, 2)]
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
