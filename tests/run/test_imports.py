"""Recordings become history once, whatever of them is there already."""

import json

import msgspec
import pytest
from made_fixes import NOON_S, fix
from pyarrow import parquet

from skyless.cli.main import main
from skyless.core.site import Site
from skyless.run.fix_batch import records_of
from skyless.run.history.layout import current_events, current_files, rows_of, site_folder
from skyless.run.history.writer import Writer
from skyless.run.mqtt.messages import SiteMessage, Zone, ZoneEvent, ZonesMessage
from skyless.run.mqtt.topics import fix_topic, site_topic, zone_event_topic, zones_topic
from skyless.run.recordings.recorder import McapFile, McapRecorder
from skyless.sim.lab import lab_site

SITE = 7
ZONE = Zone("z1", "door", ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)))


def recording(path, serials, tags=("ann", "bob"), *, site=SITE, start_s=NOON_S):
    """Fixes of two tags, ten a second, their serials in ``x_mm``; each tenth enters a zone."""
    file = McapFile(path)
    recorder = McapRecorder(file)
    lab: Site = msgspec.structs.replace(lab_site(), id=site)
    recorder.add(site_topic(site), msgspec.json.encode(SiteMessage(lab, True, start_s)), start_s)
    recorder.add(zones_topic(site), msgspec.json.encode(ZonesMessage((ZONE,), lab.name)), start_s)
    for serial in serials:
        unix_s = start_s + 0.1 * serial
        for tag in tags:
            message = fix(tag, serial, unix_s, (serial / 1000.0, 0.0, 0.0))
            recorder.add(fix_topic(site, tag), msgspec.json.encode(message), unix_s + 0.01)
        if serial % 10 == 0:
            event = ZoneEvent("z1", "door", tags[0], "enter", unix_s, (0.0, 0.0, 0.0))
            recorder.add(zone_event_topic(site, "z1"), msgspec.json.encode(event), unix_s + 0.02)
    file.close()
    return path


def imported(capsys, path, folder, *more):
    assert main(["history", "import", str(path), "--to", str(folder), "--json", *more]) == 0
    return json.loads(capsys.readouterr().out)


def rows(folder, site=SITE):
    names = parquet.read_table(site_folder(folder, site) / "names.parquet", partitioning=None).to_pylist()
    of = {row["tag"]: row["name"] for row in names}
    tables = (parquet.read_table(file, partitioning=None).to_pylist() for file in current_files(folder, site))
    return sorted(
        (of[row["tag"]], row["x_mm"], row["t"].timestamp(), row["flags"]) for table in tables for row in table
    )


def test_a_recording_becomes_history_once(tmp_path, capsys):
    path, folder = recording(tmp_path / "walk.mcap", range(100)), tmp_path / "history"
    found = imported(capsys, path, folder)
    assert (found["site"], found["fixes"], found["known_fixes"], found["events"]) == (SITE, 200, 0, 10)
    expected = [(tag, n, pytest.approx(NOON_S + 0.1 * n, abs=2e-3), 64) for tag in ("ann", "bob") for n in range(100)]
    assert rows(folder) == expected
    zones = parquet.read_table(site_folder(folder, SITE) / "zones.parquet", partitioning=None).to_pylist()
    assert zones == [{"zone": "z1", "name": "door", "corners_m": "[[0.0,0.0],[1.0,0.0],[1.0,1.0]]"}]
    (events,) = current_events(folder, SITE)
    assert parquet.read_table(events, partitioning=None)["tag"].to_pylist() == ["ann"] * 10
    before = {file: file.read_bytes() for file in folder.rglob("*.parquet")}
    found = imported(capsys, path, folder)
    assert (found["fixes"], found["known_fixes"], found["events"]) == (0, 200, 0)
    assert {file: file.read_bytes() for file in folder.rglob("*.parquet")} == before


def test_a_longer_recording_and_one_beside_the_running_history_add_what_is_new(tmp_path, capsys):
    folder = tmp_path / "history"
    writer = Writer(folder, SITE)
    for serial in range(30, 60):  # what the running history has received itself, with its own times of arrival
        message = fix("bob", serial, NOON_S + 0.1 * serial, (serial / 1000.0, 0.0, 0.0))
        number = writer.number(message, NOON_S)
        writer.fixes.add(records_of([(number, message)], simulated=True), NOON_S + 0.1 * serial + 3.0)
    writer.close()
    found = imported(capsys, recording(tmp_path / "a.mcap", range(50)), folder)
    assert (found["fixes"], found["known_fixes"], found["events"]) == (80, 20, 5)
    found = imported(capsys, recording(tmp_path / "b.mcap", range(100)), folder)
    assert (found["fixes"], found["known_fixes"], found["events"]) == (90, 110, 5)
    assert [row[:2] for row in rows(folder)] == [(tag, n) for tag in ("ann", "bob") for n in range(100)]
    numbers = [
        number for file in current_files(folder, SITE) for number in range(rows_of(file)[0], rows_of(file)[1] + 1)
    ]
    assert numbers == list(range(1, 201))


def test_a_recording_of_no_site_needs_one(tmp_path, capsys, complaint):
    path = tmp_path / "empty.mcap"
    McapFile(path).close()
    assert "does not say of which site it is; --site-id should" in complaint(
        "history", "import", path, "--to", tmp_path / "history"
    )
    assert not (tmp_path / "history").exists()
    assert imported(capsys, path, tmp_path / "history", "--site-id", "3")["fixes"] == 0


def test_a_file_that_is_no_recording_is_named(tmp_path, complaint):
    assert "it should be that of an MCAP" in complaint("history", "import", __file__, "--to", tmp_path / "history")
    assert not (tmp_path / "history").exists()
