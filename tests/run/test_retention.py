"""What is joined, thinned and removed, and that readers see every row once whenever the work stops."""

import re
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from made_fixes import DAY_S, NOON_S, fix, in_files, records
from pyarrow import parquet
from test_writer import dying

from skyless.core.errors import SkylessError
from skyless.run.fix_batch import records_of
from skyless.run.history import writer as writer_module
from skyless.run.history.layout import Place, current_events, current_files, file_name, rows_of, site_folder
from skyless.run.history.tables import Event, connection, fix_columns
from skyless.run.history.writer import THINNING, Keep, Writer, tidy

KEEP = Keep(days=30.0, full_days=7.0, event_days=60.0)


def filled(folder, days, files=3):
    """Three files of two rows a day; the serials go on."""
    writer = Writer(folder, 1)
    number, serial = writer.number(fix(), NOON_S), 1
    for day in days:
        for _ in range(files):
            unix_s = NOON_S + DAY_S * day
            batch = records([serial, serial + 1], number)
            batch["unix_us"] = [round(1e6 * (unix_s + 300.0 * k)) for k in (serial, serial + 1)]
            writer.fixes.add(batch, unix_s)
            event = Event(datetime.fromtimestamp(unix_s + 1e-3 * serial, UTC), "enter", "tag1", "z1")
            writer.events.add((event,), unix_s)
            writer.write()
            serial += 2
    writer.close()
    return list(range(1, serial))


def events_in(folder):
    return [t for file in current_events(folder, 1) for t in parquet.read_table(file)["t"].cast("int64").to_pylist()]


@pytest.mark.site
def test_a_day_that_is_over_becomes_one_file_and_old_ones_go(tmp_path):
    serials = filled(tmp_path, (-31, -2, -1, 0))
    assert len(current_files(tmp_path, 1)) == len(current_events(tmp_path, 1)) == 12
    events = events_in(tmp_path)
    tidy(tmp_path, 1, KEEP, NOON_S)
    assert (in_files(tmp_path), events_in(tmp_path)) == (serials[6:], events)
    assert [rows_of(file) for file in current_files(tmp_path, 1)] == [(7, 12), (13, 18), (19, 20), (21, 22), (23, 24)]
    assert len(current_events(tmp_path, 1)) == 6
    assert not list(site_folder(tmp_path, 1).glob(f"day={datetime.fromtimestamp(NOON_S - 31 * DAY_S, UTC).date()}"))
    everything = set(site_folder(tmp_path, 1).glob("**/day=*/*"))
    assert everything == {*current_files(tmp_path, 1), *current_events(tmp_path, 1)}


def test_files_that_are_large_together_are_not_joined(tmp_path, monkeypatch):
    monkeypatch.setattr(writer_module, "JOINED_ROWS", 5)
    filled(tmp_path, (-1,), files=4)
    tidy(tmp_path, 1, KEEP, NOON_S)
    assert [rows_of(file) for file in current_files(tmp_path, 1)] == [(1, 4), (5, 8)]


def test_events_that_are_too_old_go(tmp_path):
    filled(tmp_path, (-100, -70, -3))
    tidy(tmp_path, 1, Keep(days=1000.0, full_days=1000.0, event_days=60.0), NOON_S)
    assert len(events_in(tmp_path)) == 3


@pytest.mark.site
def test_readers_see_every_row_once_when_the_work_stops_at_any_operation(tmp_path_factory):
    operation, finished = 0, False
    while not finished:
        folder = tmp_path_factory.mktemp("history")
        with dying(10**9):
            serials = filled(folder, (-2, -1), 2)
        events = events_in(folder)
        with dying(operation) as disk:
            tidy(folder, 1, KEEP, NOON_S)
        finished = not disk.dead
        assert (in_files(folder), events_in(folder)) == (serials, events)
        Writer(folder, 1).close()
        tidy(folder, 1, KEEP, NOON_S)
        assert (in_files(folder), events_in(folder)) == (serials, events)
        assert len(current_files(folder, 1)) == 2
        operation += 1
    assert operation > 8


RANGES = st.lists(st.tuples(st.integers(1, 30), st.integers(0, 9)), max_size=8)


@settings(max_examples=50)
@given(RANGES)
def test_current_files_are_those_that_no_other_covers(tmp_path_factory, ranges):
    folder = tmp_path_factory.mktemp("history")
    day = site_folder(folder, 1) / "day=2026-11-26"
    day.mkdir(parents=True)
    spans = {(first, first + more) for first, more in ranges}
    for first, last in spans:
        (day / file_name(first, last)).touch()
    (day / "notes.parquet").touch()
    (day / f"{file_name(1, 99)}.tmp").touch()
    expected = {one for one in spans if not any(o != one and o[0] <= one[0] and one[1] <= o[1] for o in spans)}
    assert [rows_of(file) for file in current_files(folder, 1)] == sorted(expected)


def walk(seconds, speed_mps, tag=1):
    """Records of one tag in a straight line, four a second."""
    times_s = np.arange(0.0, seconds, 0.25)
    return records_of(
        [(tag, fix(unix_s=NOON_S + t, position_m=(speed_mps * t, 0.0, 1.0))) for t in times_s], simulated=False
    )


def thinned(columns):
    """Rows that stay, sorted by tag and time."""
    with connection() as duck:
        duck.register("given", columns)
        rows = "SELECT * REPLACE (make_timestamptz(1000 * t) AS t) FROM given"
        sql = THINNING.format(columns="tag, epoch_ms(t), x_mm", rows=rows) + " ORDER BY tag, t"
        return duck.execute(sql).fetchall()


def test_of_a_moving_tag_one_in_ten_seconds_stays_and_of_one_at_rest_one_in_a_minute():
    found = thinned(fix_columns(np.concatenate([walk(120.0, 1.0, 1), walk(120.0, 0.005, 2)])))
    assert [tag for tag, _, _ in found] == [1] * 12 + [2] * 2
    assert [ms / 1000 - NOON_S for _, ms, _ in found] == [*range(0, 120, 10), 0.0, 60.0]
    assert [x_mm for _, _, x_mm in found[:3]] == [0, 10_000, 20_000]


@settings(max_examples=50)
@example([(1, 0, 0), (1, 20_000, 500), (2, 0, 0), (2, 20_000, 501)])
@given(
    st.lists(st.tuples(st.integers(1, 3), st.integers(0, 200_000), st.integers(-3000, 3000)), min_size=1, max_size=60)
)
def test_thinning_keeps_rows_of_every_tag_and_minute(rows):
    batch = records(range(len(rows)))
    for row, (tag, ms, x_mm) in zip(batch, rows, strict=True):
        row["tag"], row["unix_us"], row["position_mm"][0] = tag, 1000 * ms, x_mm
    columns = fix_columns(batch)
    whole = list(zip(*(columns[name].tolist() for name in ("tag", "t", "x_mm")), strict=True))
    kept = thinned(columns)
    assert set(kept) <= set(whole)

    def parts(some, seconds):
        return [(tag, ms // 1000 // seconds) for tag, ms, _ in some]

    assert set(parts(kept, 60)) == set(parts(whole, 60))
    assert len(parts(kept, 10)) == len(set(parts(kept, 10)))  # at most one in ten seconds
    for tag, minute in set(parts(whole, 60)):
        mine = [row for row in whole if parts([row], 60) == [(tag, minute)]]
        xs = [x_mm for _, _, x_mm in mine]
        expected = len(set(parts(mine, 10))) if max(xs) - min(xs) > 500 else 1
        assert parts(kept, 60).count((tag, minute)) == expected


@pytest.mark.site
def test_what_the_daily_work_meets(tmp_path):
    """Places at the ends of their range, long texts, a file that is damaged, and a folder like a pattern's."""
    filled(tmp_path / "h1", (0,))
    folder = tmp_path / "h[1]"
    filled(folder, (-1,))
    writer = Writer(folder, 1)
    ends = records([1, 2], 1, NOON_S - 9 * DAY_S)
    ends["position_mm"][:, 0] = -(2**31), 2**31 - 1
    writer.fixes.add(ends, NOON_S - 9 * DAY_S)
    at = datetime.fromtimestamp(NOON_S - 2 * DAY_S, UTC)
    for _ in range(2):
        writer.events.add([Event(at, "enter", "tag1", "z1", text="x" * 300)] * 100_000, NOON_S - 2 * DAY_S)
        writer.write()
    writer.close()
    tidy(folder, 1, KEEP, NOON_S)
    assert sorted(in_files(folder)) == [-(2**31), *range(1, 7)]
    assert len(current_events(folder, 1)) == 2
    damaged = filled(folder, (0,)) and current_files(folder, 1)[-2]
    damaged.write_bytes(damaged.read_bytes()[:4] + b"\xff" * 200 + damaged.read_bytes()[204:])
    with pytest.raises(
        SkylessError, match=re.escape(f"{damaged} cannot be read; it should be a Parquet file with tag")
    ):
        tidy(folder, 1, KEEP, NOON_S + DAY_S)


def test_a_day_is_joined_and_thinned_once_and_keeps_its_numbers(tmp_path):
    filled(tmp_path, (-8, -7))
    tidy(tmp_path, 1, KEEP, NOON_S)
    files = current_files(tmp_path, 1)
    before = {file: file.stat().st_mtime_ns for file in files}
    assert [rows_of(file) for file in files] == [(1, 6), (7, 12)]
    assert [writer_module.THINNED.encode() in parquet.read_metadata(file).metadata for file in files] == [True, False]
    tidy(tmp_path, 1, KEEP, NOON_S)
    assert {file: file.stat().st_mtime_ns for file in current_files(tmp_path, 1)} == before


@pytest.mark.parametrize("are_old", [False, True])
def test_the_place_in_the_stream_outlasts_joining_thinning_and_the_last_row(tmp_path, are_old):
    writer = Writer(tmp_path, 1)
    for number in (1, 2, 3):
        writer.fixes.place = writer.events.place = Place("site 2026", number)
        writer.fixes.add(records([number], writer.number(fix(), NOON_S)), NOON_S)
        writer.write()
    writer.close()
    for file in tmp_path.rglob("*.parquet") if are_old else ():  # up to version 0.2 PyArrow wrote them
        parquet.write_table(parquet.read_table(file, partitioning=None), file, coerce_timestamps="ms")
    for days, files, rows in ((1, 1, [1, 2, 3]), (8, 1, [1]), (30, 1, [1]), (31, 1, []), (40, 1, [])):
        tidy(tmp_path, 1, KEEP, NOON_S + DAY_S * days)
        assert (len(current_files(tmp_path, 1)), in_files(tmp_path)) == (files, rows)
        writer = Writer(tmp_path, 1)
        assert (writer.fixes.place, writer.fixes.last) == (Place("site 2026", 3), 3)
        writer.close()
