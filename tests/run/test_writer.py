"""The writer of a history: killed at any operation on the disk, it goes on in the stream where its files end."""

import contextlib
import errno
import os
import random
from datetime import UTC, datetime
from pathlib import Path

import pyarrow as pa
import pytest
from made_fixes import DAY_S, NOON_S, fix, in_files, records
from pyarrow import parquet

from skyless.core.errors import SkylessError
from skyless.run.fix_batch import records_of
from skyless.run.history import writer as writer_module
from skyless.run.history.layout import FIX_COLUMNS, Place, current_events, current_files, rows_of, site_folder
from skyless.run.history.tables import Event, fix_columns, write_table
from skyless.run.history.writer import Writer
from skyless.run.web import HistoryLimits
from support.parquet_files import ARROW_TYPES


class Killed(BaseException):
    """Nothing after this is done."""


class Disk:
    """Lets a program die at the n-th operation on the disk."""

    def __init__(self, patch, operations):
        self.left, self.dead = operations, False
        patch.setattr(os, "fsync", lambda _: self.operate())  # a death by a signal costs nothing that was written
        for name in ("replace", "unlink", "mkdir"):
            patch.setattr(Path, name, self._counted(getattr(Path, name)))

    def operate(self):
        self.left -= not self.dead
        if self.left < 0:
            self.dead = True
            raise Killed

    def _counted(self, act):
        def counted(*arguments, **named):
            self.operate()
            return act(*arguments, **named)

        return counted


@contextlib.contextmanager
def dying(operations):
    """A program in the block dies at the operation with this number."""
    with pytest.MonkeyPatch.context() as patch:
        disk = Disk(patch, operations)
        with contextlib.suppress(Killed):
            yield disk


def one_life(folder, messages, write_after):
    """Take the messages of a stream, of three fixes and an event each, that are not in files; write now and then."""
    writer = Writer(folder, 1)
    intakes = writer.fixes, writer.events
    for number in range(1 + min(intake.place.number for intake in intakes), messages + 1):
        arrived_s = NOON_S + DAY_S * (number // 4)
        tag = writer.number(fix(f"tag{number % 5}"), NOON_S)
        event = Event(datetime.fromtimestamp(NOON_S + number, UTC), "enter", "ann", "z1")
        for intake, rows in zip(intakes, (records(range(3 * number, 3 * number + 3), tag), [event]), strict=True):
            if number > intake.place.number:
                intake.place = Place("site", number)
                intake.add(rows, arrived_s)
        if number % write_after == 0:
            writer.write()
    writer.close()


def check(folder, messages):
    """Each row of the stream is in the files once, under its tag's name."""
    assert sorted(in_files(folder)) == [*range(3, 3 * messages + 3)]
    assert numbers(current_files(folder, 1)) == [*range(1, 3 * messages + 1)]
    assert numbers(current_events(folder, 1)) == [*range(1, messages + 1)]
    names = parquet.read_table(site_folder(folder, 1) / "names.parquet", partitioning=None).to_pydict()
    of = dict(zip(names["tag"], names["name"], strict=True))
    assert len(of) == len(set(of.values())) == 5
    for file in current_files(folder, 1):
        rows = parquet.read_table(file, partitioning=None)
        assert [of[tag] for tag in rows["tag"].to_pylist()] == [f"tag{x // 3 % 5}" for x in rows["x_mm"].to_pylist()]
    assert not list(folder.rglob("*.tmp"))


def numbers(files):
    return [number for first, last in map(rows_of, files) for number in range(first, last + 1)]


@pytest.mark.site
def test_a_writer_that_dies_at_any_operation_loses_nothing_and_repeats_nothing(tmp_path_factory):
    operation, finished = 0, False
    while not finished:
        folder = tmp_path_factory.mktemp("history")
        with dying(operation) as disk:
            one_life(folder, 7, 3)
        finished = not disk.dead
        one_life(folder, 9, 2)
        check(folder, 9)
        operation += 1
    assert operation > 20


@pytest.mark.site
def test_a_random_series_of_deaths(tmp_path):
    chance, deaths = random.Random(36), 0
    for messages in range(5, 105, 5):
        with dying(chance.randrange(80)) as disk:
            one_life(tmp_path, messages, chance.randrange(1, 5))
        deaths += disk.dead
    assert 5 < deaths < 20
    one_life(tmp_path, 105, 4)
    check(tmp_path, 105)


def no_room(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_what_cannot_become_a_file_waits_and_then_becomes_files(tmp_path, monkeypatch):
    monkeypatch.setattr(writer_module, "FILE_ROWS", 20)
    writer = Writer(tmp_path, 1)
    tag = writer.number(fix(), NOON_S)
    with monkeypatch.context() as patch:
        patch.setattr(writer_module, "write_table", no_room)
        for serial in range(1, 101):
            writer.fixes.add(records([serial], tag), NOON_S)
            with pytest.raises(OSError, match="No space"):
                writer.write()
        writer.events.add((Event(datetime.fromtimestamp(NOON_S, UTC), "enter", "ann", "z1"),), NOON_S)
    assert (writer.waiting, in_files(tmp_path)) == (101, [])
    writer.close()
    assert in_files(tmp_path) == [*range(1, 101)]
    assert [rows_of(file) for file in current_files(tmp_path, 1)] == [(n, n + 19) for n in range(1, 101, 20)]
    writer = Writer(tmp_path, 1)
    writer.fixes.add(records([101], tag), NOON_S)
    assert (writer.waiting, writer.fixes.taken) == (1, 1)
    writer.close()


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


def test_a_history_goes_on_with_streams_of_the_same_server_only(tmp_path):
    for source, other in (("site", "hub"), ("hub", "site")):
        writer = Writer(tmp_path / source, 1, source)
        writer.fixes.place = Place(f"{source} 2026", 7)
        writer.fixes.add(records([1], writer.number(fix(), NOON_S)), NOON_S)
        writer.close()
        with pytest.raises(SkylessError, match=f"streams of a {source}, not of a {other}; it should be another folder"):
            Writer(tmp_path / source, 1, other)
        assert Writer(tmp_path / source, 1, source).fixes.place == Place(f"{source} 2026", 7)


def test_a_journal_of_an_older_version_is_not_passed_over(tmp_path):
    site_folder(tmp_path, 1).mkdir()
    (site_folder(tmp_path, 1) / "journal.sqlite").touch()
    with pytest.raises(SkylessError, match=r"journal\.sqlite may have rows that are in no Parquet file; end skyless"):
        Writer(tmp_path, 1)


def test_of_a_disk_that_becomes_full_meanwhile_the_error_says_so(tmp_path):
    (tmp_path / "fixes.parquet.tmp").symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left on device") as caught:
        write_table(fix_columns(records([1])), FIX_COLUMNS, tmp_path / "fixes.parquet")
    assert caught.value.errno == errno.ENOSPC
    assert not list(tmp_path.iterdir())


def test_too_many_tags_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(writer_module, "LIMITS", HistoryLimits(tags=2))
    writer = Writer(tmp_path, 1)
    assert [writer.number(fix(name), NOON_S) for name in ("a", "b", "c", "a")] == [1, 2, None, 1]
    assert writer.drops == {"too-many-tags": 1}
    writer.close()


def test_the_columns_are_those_of_the_layout_and_sorted(tmp_path):
    found = [(2, fix("b", unix_s=5.0)), (1, fix("a", unix_s=9.0)), (2, fix("b", unix_s=4.0, hpl_m=0.5))]
    write_table(
        fix_columns(records_of(found, simulated=True)), FIX_COLUMNS, tmp_path / "fixes.parquet", {"key": "it's"}
    )
    table = parquet.read_table(tmp_path / "fixes.parquet")
    assert table.schema.metadata[b"key"] == b"it's"
    kinds = {field.name: field.type for field in table.schema}
    assert kinds == {name: ARROW_TYPES[kind] for name, kind in FIX_COLUMNS.items()} | {"t": pa.timestamp("us", "UTC")}
    assert table["tag"].to_pylist() == [1, 2, 2]
    assert table["t"].cast("int64").to_pylist() == [9_000_000, 4_000_000, 5_000_000]
    assert table["hpl_cm"].to_pylist() == [65535, 50, 65535]
    assert table.select(["x_mm", "y_mm", "z_mm"]).to_pylist()[0] == {"x_mm": 1000, "y_mm": 2000, "z_mm": 3000}


@pytest.mark.parametrize("height_known", [False, True])
@pytest.mark.parametrize("variances", [(4e-4, 9e-4, 1e-4), (1.0, 2.0, 3.0), (1e9, 1.0, 1.0), (0.0, 0.0, 0.0)])
def test_the_standard_deviation_is_that_of_the_message(variances, height_known):
    if height_known:
        variances = (*variances[:2], 0.0)
    message = fix(variances=variances, height_known=height_known)
    table = fix_columns(records_of([(1, message)], simulated=False))
    assert table["std_mm"][0] == pytest.approx(min(1000.0 * message.std_m, 65535.0), abs=1.0)
