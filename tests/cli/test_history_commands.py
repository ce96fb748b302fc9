"""``skyless history``: what it answers on the command line, as a table, as JSON and as a picture."""

import json
import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet

from skyless.cli.main import main
from skyless.run.history import layout
from support.parquet_files import arrow_table

pytestmark = pytest.mark.site

BEGIN = datetime(2026, 11, 20, 8, tzinfo=UTC).timestamp()
RANGE = ("--from", str(BEGIN), "--to", str(BEGIN + 3600.0))
DOCUMENT = (Path(__file__).parents[2] / "docs" / "history.md").read_text(encoding="utf-8")


def write(file, columns, rows):
    file.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(arrow_table(columns, dict(zip(columns, zip(*rows, strict=True), strict=True))), file)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An hour of two tags that walk side by side."""
    folder = tmp_path_factory.mktemp("history")
    site, s = layout.site_folder(folder, 5), np.arange(0, 3600)
    x_mm = np.rint(3000.0 + 2000.0 * np.sin(s / 60.0)).astype(int).tolist()
    ms = [round(1000.0 * (BEGIN + one)) for one in s.tolist()]
    fixes = [(tag, t, x, 1000 * tag, 1200, 50, 65535, 8) for tag in (1, 2) for t, x in zip(ms, x_mm, strict=True)]
    write(site / "day=2026-11-20" / layout.file_name(1, 7200), layout.FIX_COLUMNS, fixes)
    write(site / "names.parquet", layout.NAME_COLUMNS, [(1, "[red]ann", 0), (2, "bob", 0)])
    write(site / "assets.parquet", layout.ASSET_COLUMNS, [("bob", "Forklift 3")])
    write(site / "zones.parquet", layout.ZONE_COLUMNS, [("dock", "Dock", "[[1, 0], [3, 0], [3, 3], [1, 3]]")])
    events = [
        (ms[60], "enter", "[red]ann", "dock", None, None, ""),
        (ms[90], "alarm-raised", None, "dock", "[red]ann", "late/ann/1", "ann is late"),
        (ms[660], "leave", "[red]ann", "dock", None, None, ""),
    ]
    write(site / "events" / "day=2026-11-20" / layout.file_name(1, 3), layout.EVENT_COLUMNS, events)
    return folder


def run(folder, *words):
    return main(["history", *words, "--history", str(folder), *RANGE])


QUESTIONS = {
    "track": ("[red]ann",),
    "heatmap": ("--cell", "0.5"),
    "dwell": ("--zone", "dock"),
    "contacts": ("forklift 3",),
}
ANSWERS = {
    "track": lambda track: (track["fixes"], len(track["points"])) == (3600, 2000) and 65.0 < track["length_m"] < 80.0,
    "heatmap": lambda heatmap: sum(heatmap["seconds"]) == pytest.approx(2 * 3599.0),
    "dwell": lambda dwell: (
        [(one["tag"], one["zone_name"], one["seconds"]) for one in dwell] == [("[red]ann", "Dock", 600.0)]
    ),
    "contacts": lambda found: (
        [(one["tag"], one["tag_name"], one["other"], one["least_m"]) for one in found]
        == [("bob", "Forklift 3", "[red]ann", 1.0)]
    ),
}
SHOWN = {"track": "length", "heatmap": "1 h 59 min", "dwell": "10 min 00 s", "contacts": "Forklift 3"}


@pytest.mark.parametrize("question", QUESTIONS)
def test_answers_as_json_and_as_a_table(folder, question, capsys):
    assert run(folder, question, *QUESTIONS[question], "--json") == 0
    (line,) = capsys.readouterr().out.splitlines()
    answer = json.loads(line)
    assert (answer["site"], answer["from_unix_s"], answer["known_until_unix_s"]) == (5, BEGIN, BEGIN + 3599.0)
    assert ANSWERS[question](answer[question])
    assert run(folder, question, *QUESTIONS[question]) == 0
    out = capsys.readouterr().out
    assert SHOWN[question] in out
    assert "seconds" not in out
    assert "[red]ann" in out or question == "heatmap"


@pytest.mark.parametrize("question", QUESTIONS)
def test_pictures(folder, question, tmp_path, capsys):
    picture = tmp_path / "answer.svg"
    assert run(folder, question, *QUESTIONS[question], "--plot", str(picture)) == 0
    text = picture.read_text(encoding="utf-8")
    assert text.startswith("<?xml")
    assert ("[red]ann" if question == "contacts" else "Dock") in text


def test_a_picture_names_the_asset(folder, tmp_path, capsys):
    picture = tmp_path / "contacts.svg"
    assert run(folder, "contacts", "[red]ann", "--plot", str(picture)) == 0
    assert "Forklift 3" in picture.read_text(encoding="utf-8")
    assert "bob" not in capsys.readouterr().out


def test_sql(folder, tmp_path, capsys):
    assert run(folder, "sql", "SELECT text, unix_s FROM events WHERE kind = 'alarm-raised'", "--json") == 0
    assert json.loads(capsys.readouterr().out)["sql"] == [{"text": "ann is late", "unix_s": BEGIN + 90.0}]
    assert run(folder, "sql", "SELECT tag, max(x_m) AS x_m, max(time_utc) AS last FROM fixes GROUP BY tag") == 0
    out = capsys.readouterr().out
    assert all(words in out for words in ("[red]ann", "5.00", "2026-11-20 08:59:59"))
    for name in ("fixes.csv", "fixes.parquet"):
        words = ("sql", "FROM fixes WHERE tag = 'bob'", "--write", str(tmp_path / name), "--json")
        assert run(folder, *words) == 0
        assert json.loads(capsys.readouterr().out)["rows"] == 3600
        assert run(folder, *words) == 2
        assert "--force overwrites it" in capsys.readouterr().err
        assert run(folder, *words, "--force") == 0
        capsys.readouterr()
    assert len((tmp_path / "fixes.csv").read_text().splitlines()) == 3601


@pytest.mark.parametrize("query", re.findall('skyless history sql "(.*?)"', DOCUMENT, re.DOTALL))
def test_sql_of_the_document(folder, query, capsys):
    assert run(folder, "sql", query, "--json") == 0
    assert json.loads(capsys.readouterr().out)["sql"] or "tag7" in query


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("track", "nobody"), "has no tag 'nobody'; it has [red]ann, bob"),
        (("dwell", "--zone", "nowhere"), "has no zone 'nowhere'; it has dock"),
        (("heatmap", "--site-id", "6"), "no history of site 6; it holds site 5"),
        (("heatmap", "--plot", "x.gif"), "--plot is 'x.gif'"),
        (("heatmap", "--cell", "-1"), "--cell is -1.0"),
        (("track", "bob", "--points", "1"), "--points is 1"),
        (("sql", "SELEC 1"), "the SQL cannot be answered: Parser Error: syntax error at or near"),
        (("sql", "FROM fixes", "--write", "x.txt"), "x.txt ends with '.txt'; it should end with .csv or .parquet"),
    ],
)
def test_a_slip_is_one_line(folder, words, said, capsys):
    assert run(folder, *words) == 2
    err = capsys.readouterr().err
    assert (err.count("\n"), said in err) == (1, True), err


def test_where_there_is_no_history_or_no_such_time(tmp_path, folder, complaint):
    assert "it should be the folder of a site's history, and it holds none" in complaint("history", "heatmap")
    (folder / "site=9").mkdir()
    assert "the sites 5, 9; --site-id chooses one" in complaint("history", "heatmap", "--history", folder)
    (folder / "site=9").rmdir()
    assert "--from is 'soonish'; it should be a time such as" in complaint(
        "history", "heatmap", "--history", folder, "--from", "soonish"
    )


def test_a_range_without_fixes_ends_with_1(folder, tmp_path, capsys):
    past = ("--history", str(folder), "--from", "1990-01-01", "--to", "1990-01-02")
    assert main(["history", "heatmap", *past, "--plot", str(tmp_path / "empty.png")]) == 1
    assert [main(["history", *words, *past]) for words in (("track", "bob"), ("heatmap",), ("dwell",))] == [1, 1, 0]
    assert "nothing" in capsys.readouterr().out
