"""The writer of a history: killed at any operation on the disk, it loses nothing that the journal has."""

import contextlib
import errno
import os
import random
import sqlite3
from datetime import UTC, datetime
from pathlib import Path

import pytest
from made_fixes import DAY_S, NOON_S, fix, in_files, on_disk, records
from pyarrow import parquet

from skyless.core.errors import SkylessError
from skyless.run.fix_batch import records_of
from skyless.run.history import writer as writer_module
from skyless.run.history.layout import FIX_COLUMNS, current_events, current_files, rows_of, site_folder
from skyless.run.history.tables import Event, fix_table
from skyless.run.history.writer import Journal, Writer
from skyless.run.web import HistoryLimits


class Killed(BaseException):
    """Nothing after this is done."""


class Disk:
    """Lets a program die at the n-th operation on the disk."""

    def __init__(self, patch, operations):
        self.left, self.dead, self.opened = operations, False, []
        patch.setattr(sqlite3, "connect", self._opening(sqlite3.connect))
        patch.setattr(os, "fsync", lambda _: self.operate())  # a death by a signal costs nothing that was written
        for name in ("replace", "unlink", "mkdir"):
            patch.setattr(Path, name, self._counted(getattr(Path, name)))
        patch.setattr(Journal, "transaction", self._transaction(Journal.transaction))

    def operate(self):
        self.left -= not self.dead
        if self.left < 0:
            self.dead = True
            raise Killed

    def end(self):
        """What the system does for a program that has ended."""
        for connection in self.opened:
            connection.close()

    def _opening(self, connect):
        def opening(*arguments, **named):
            self.opened.append(connect(*arguments, **named))
            return self.opened[-1]

        return opening

    def _counted(self, act):
        def counted(*arguments, **named):
            self.operate()
            return act(*arguments, **named)

        return counted

    def _transaction(self, transaction):
        @contextlib.contextmanager
        def counted(journal):
            with transaction(journal) as sql:
                yield sql
                self.operate()  # before it is committed
            self.operate()

        return counted


@contextlib.contextmanager
def dying(operations):
    """A program in the block dies at the operation with this number."""
    with pytest.MonkeyPatch.context() as patch:
        disk = Disk(patch, operations)
        with contextlib.suppress(Killed):
            yield disk
        disk.end()


def one_life(folder, serials, write_after):
    """Store batches of three, and write files now and then; yields what is acknowledged."""
    writer = Writer(folder, 1)
    for count, first in enumerate(range(serials.start, serials.stop, 3), 1):
        tags = [writer.number(fix(tag), NOON_S) for tag in ("ann", f"tag{first % 5}")]
        batch = records(range(first, min(first + 3, serials.stop)), tag=tags[0])
        writer.fixes.add(batch, NOON_S + DAY_S * (first // 10))
        writer.store()
        yield from batch["position_mm"][:, 0].tolist()
        if count % write_after == 0:
            writer.write()
    writer.close()


@pytest.mark.site
def test_a_writer_that_dies_at_any_operation_loses_nothing_and_repeats_nothing(tmp_path_factory):
    operation, finished = 0, False
    while not finished:
        folder = tmp_path_factory.mktemp("history")
        acknowledged = []
        with dying(operation) as disk:
            acknowledged.extend(one_life(folder, range(1, 22), 4))
        finished = not disk.dead
        stored = on_disk(folder)
        assert stored[: len(acknowledged)] == acknowledged, operation
        assert stored == sorted(set(stored))  # a batch that was not acknowledged may be there
        with dying(10**9):
            later = list(one_life(folder, range(101, 110), 2))
        assert in_files(folder) == stored + later == on_disk(folder)
        assert numbers(folder) == list(range(1, len(stored + later) + 1))
        assert not list(folder.rglob("*.tmp"))
        operation += 1
    assert operation > 40


def numbers(folder):
    ranges = [rows_of(file) for file in current_files(folder, 1)]
    return [number for first, last in ranges for number in range(first, last + 1)]


def test_a_random_series_of_deaths(tmp_path):
    chance, expected, serial = random.Random(36), [], 1
    for _ in range(20):
        acknowledged = []
        with dying(chance.randrange(120)):
            acknowledged.extend(one_life(tmp_path, range(serial, serial + 40), 5))
        before, expected = expected, on_disk(tmp_path)
        assert expected[: len(before) + len(acknowledged)] == before + acknowledged
        serial += 100
    assert len(expected) > 150
    assert expected == sorted(set(expected))
    Writer(tmp_path, 1).close()
    assert in_files(tmp_path) == expected


def test_numbers_of_tags_are_known_before_they_are_used_and_never_given_twice(tmp_path):
    given = {}
    for life in range(3):
        writer = Writer(tmp_path, 1)
        for name in ("ann", f"bob{life}"):
            given.setdefault(name, set()).add(writer.number(fix(name), NOON_S))
        writer.store()
        names = parquet.read_table(site_folder(tmp_path, 1) / "names.parquet", partitioning=None).to_pydict()
        assert dict(zip(names["name"], names["tag"], strict=True)) == {
            name: min(found) for name, found in given.items()
        }
        writer.close()
    assert sorted(number for found in given.values() for number in found) == [1, 2, 3, 4]


def test_a_name_that_cannot_be_kept_keeps_its_fixes_out_of_the_journal(tmp_path, monkeypatch):
    writer = Writer(tmp_path, 1)
    number = writer.number(fix("ann"), NOON_S)
    writer.fixes.add(records([1], number), NOON_S)
    with monkeypatch.context() as patch:
        patch.setattr(writer_module, "write_table", no_room)
        with pytest.raises(OSError, match="No space"):
            writer.store()
    assert on_disk(tmp_path) == []
    writer.store()
    assert on_disk(tmp_path) == [1]
    writer.close()


def no_room(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextlib.contextmanager
def full_disk(writer):
    """SQLite's own error of a full disk: its file may not grow."""
    with writer.journal.transaction() as sql:
        sql.execute("PRAGMA max_page_count = 1")
    yield
    with writer.journal.transaction() as sql:
        sql.execute("PRAGMA max_page_count = 1000000")


def test_a_full_disk_costs_the_oldest_rows_that_wait_and_is_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(writer_module, "LIMITS", HistoryLimits(waiting_rows=1000))
    writer = Writer(tmp_path, 1)
    writer.number(fix(), NOON_S)
    writer.fixes.add(records([1, 2]), NOON_S)
    writer.store()
    with full_disk(writer):
        for first in range(3, 2003, 100):
            writer.fixes.add(records(range(first, first + 100)), NOON_S)
            with pytest.raises(OSError, match="database or disk is full"):
                writer.store()
    assert (writer.fixes.lost, writer.fixes.waiting) == (1000, 1000)
    assert on_disk(tmp_path) == [1, 2]
    writer.store()
    assert on_disk(tmp_path) == [1, 2, *range(1003, 2003)]
    writer.close()
    assert in_files(tmp_path) == [1, 2, *range(1003, 2003)]


def test_a_program_that_ends_with_a_full_disk_makes_files_of_its_journal(tmp_path):
    writer = Writer(tmp_path, 1)
    writer.fixes.add(records([1], writer.number(fix(), NOON_S)), NOON_S)
    writer.store()
    writer.fixes.add(records(range(2, 1000)), NOON_S)
    with writer.journal.transaction() as sql:
        sql.execute("PRAGMA max_page_count = 1")
    with pytest.raises(OSError, match="database or disk is full"):
        writer.close()
    assert in_files(tmp_path) == [1]
    Writer(tmp_path, 1).close()


def test_what_cannot_become_a_file_stays_in_the_journal(tmp_path, monkeypatch):
    monkeypatch.setattr(writer_module, "FILE_ROWS", 20)
    writer = Writer(tmp_path, 1)
    writer.number(fix(), NOON_S)
    writer.store()
    with monkeypatch.context() as patch:
        patch.setattr(writer_module, "write_table", no_room)
        for serial in range(1, 101):
            writer.fixes.add(records([serial]), NOON_S)
            writer.store()
            with pytest.raises(OSError, match="No space"):
                writer.write()
    assert (writer.unwritten, on_disk(tmp_path)) == (100, [*range(1, 101)])
    writer.close()
    assert in_files(tmp_path) == [*range(1, 101)]
    assert len(current_files(tmp_path, 1)) == 5


def test_a_journal_that_is_damaged_is_named(tmp_path):
    Writer(tmp_path, 1).close()
    (site_folder(tmp_path, 1) / "journal.sqlite").write_bytes(b"no database" * 1000)
    with pytest.raises(SkylessError, match=r"journal\.sqlite cannot be written: file is not a database"):
        Writer(tmp_path, 1)


def test_events_go_the_same_way(tmp_path):
    writer = Writer(tmp_path, 1)
    times = [datetime.fromtimestamp(NOON_S + s, UTC) for s in (0.003, 0.001, 0.002)]
    writer.events.add([Event(t, "enter", "ann", "z1", text="ann entered door") for t in times], NOON_S)
    writer.store()
    writer.journal.close()
    del writer  # as if it had been killed
    writer = Writer(tmp_path, 1)
    assert writer.unwritten == 3
    writer.close()
    (file,) = current_events(tmp_path, 1)
    table = parquet.read_table(file, partitioning=None)
    assert table["t"].to_pylist() == sorted(times)
    assert (file.name, table["zone"][0].as_py(), table["alarm"][0].as_py()) == (f"{1:012}-{3:012}.parquet", "z1", None)


def test_only_one_writes(tmp_path):
    writer = Writer(tmp_path, 1)
    with pytest.raises(SkylessError, match="written by another program"):
        Writer(tmp_path, 1)
    Writer(tmp_path, 2).close()
    writer.close()
    Writer(tmp_path, 1).close()


def test_a_damaged_table_of_names_or_a_missing_one_is_named(tmp_path):
    writer = Writer(tmp_path, 1)
    writer.fixes.add(records([1], writer.number(fix(), NOON_S)), NOON_S)
    writer.close()
    names = site_folder(tmp_path, 1) / "names.parquet"
    whole = names.read_bytes()
    names.write_bytes(whole[:-9])
    with pytest.raises(SkylessError, match=r"names\.parquet cannot be read; it should be a Parquet file"):
        Writer(tmp_path, 1)
    names.unlink()
    with pytest.raises(SkylessError, match=r"names\.parquet is missing; it should be the table"):
        Writer(tmp_path, 1)
    names.write_bytes(whole)
    Writer(tmp_path, 1).close()


@pytest.mark.parametrize("unix_s", [-1.0, 0.0, 5_000.0, 1e300, 9e9])
def test_a_time_that_is_none_is_counted(tmp_path, unix_s):
    writer = Writer(tmp_path, 1)
    assert writer.number(fix(unix_s=unix_s), NOON_S) is None
    assert writer.drops == {"wrong-time": 1}
    writer.close()


def test_a_hubs_history_goes_on_in_its_own_folder_only(tmp_path):
    for source, position in (("", 7), ("hub ", 5)):
        writer = Writer(tmp_path / source.strip(), 1, source)
        number = writer.number(fix(), NOON_S)
        writer.fixes.add(records_of([(number, fix())], simulated=True), NOON_S, position)
        writer.close()
    assert Writer(tmp_path / "hub", 1, "hub ").fixes.position == 5
    with pytest.raises(SkylessError, match="not from the site's stream at a hub; it should be another folder"):
        Writer(tmp_path, 1, "hub ")


def test_too_many_tags_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(writer_module, "LIMITS", HistoryLimits(tags=2))
    writer = Writer(tmp_path, 1)
    assert [writer.number(fix(name), NOON_S) for name in ("a", "b", "c", "a")] == [1, 2, None, 1]
    assert writer.drops == {"too-many-tags": 1}
    writer.close()


def test_the_columns_are_those_of_the_layout_and_sorted():
    found = [(2, fix("b", unix_s=5.0)), (1, fix("a", unix_s=9.0)), (2, fix("b", unix_s=4.0, hpl_m=0.5))]
    table = fix_table(records_of(found, simulated=True))
    kinds = {field.name: str(field.type) for field in table.schema}
    assert kinds == FIX_COLUMNS
    assert table["tag"].to_pylist() == [1, 2, 2]
    assert table["t"].cast("int64").to_pylist() == [9000, 4000, 5000]
    assert table["hpl_cm"].to_pylist() == [65535, 50, 65535]
    assert table.select(["x_mm", "y_mm", "z_mm"]).to_pylist()[0] == {"x_mm": 1000, "y_mm": 2000, "z_mm": 3000}


@pytest.mark.parametrize("height_known", [False, True])
@pytest.mark.parametrize("variances", [(4e-4, 9e-4, 1e-4), (1.0, 2.0, 3.0), (1e9, 1.0, 1.0), (0.0, 0.0, 0.0)])
def test_the_standard_deviation_is_that_of_the_message(variances, height_known):
    if height_known:
        variances = (*variances[:2], 0.0)
    message = fix(variances=variances, height_known=height_known)
    table = fix_table(records_of([(1, message)], simulated=False))
    assert table["std_mm"][0].as_py() == pytest.approx(min(1000.0 * message.std_m, 65535.0), abs=1.0)
