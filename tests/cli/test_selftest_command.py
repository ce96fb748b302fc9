"""``skyless selftest``: its report, which is judged again, and what cannot be tested."""

import json

import msgspec
import pytest

from skyless.cli.main import main
from skyless.run.selftest.facts import BoardFacts, LineTest

pytestmark = pytest.mark.site


def test_a_board_that_is_not_there_is_one_sentence_and_the_report_is_judged_again(tmp_path, capsys):
    file = tmp_path / "board.json"
    assert main(["selftest", "--radio", "serial:/dev/nothing", "--report", str(file)]) == 1
    said = capsys.readouterr()
    assert said.out.splitlines()[-1] == "- failed: board A: There is no /dev/nothing (serial ports here: none)."
    assert f"wrote {file}" in said.err
    assert main(["selftest", "--read", str(file)]) == 1
    assert capsys.readouterr().out == said.out
    assert main(["selftest", "--radio", "serial:/dev/nothing", "--report", str(file)]) == 2
    assert "exists; --force overwrites it" in capsys.readouterr().err


def test_json_has_every_check(tmp_path, capsys):
    board = BoardFacts("A", "/dev/a", baud=460_800, lines=[LineTest(460_800, True, 117, 1000, 990)])
    report = {"skyless_version": "0", "made": "", "distance_m": None, "boards": [board]}
    (tmp_path / "board.json").write_bytes(msgspec.json.encode(report))
    assert main(["selftest", "--read", str(tmp_path / "board.json"), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert [one["result"] for one in found["checks"]] == ["ok", "failed"]
    assert found["checks"][1]["finding"] == "This port spoils records at every rate, 1.0 % at 460,800 baud."


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), "--radio is missing"),
        (("--radio", "spi:0.0"), "it should be one board or two"),
        (("--radio", "serial:a,b,c"), "it should be one board or two"),
        (("--radio", "serial:/dev/a,serial:/dev/a"), "it should be one board or two"),
        (("--radio", "serial:/tmp"), "is a folder"),
        (("--radio", "serial:/dev/nothing", "--report", "/no/such/board.json"), "a file in a folder that exists"),
        (("--radio", "serial:/dev/nothing", "--read", "a"), "--read judges a report again"),
        (("--read", "/no/such"), "cannot be read"),
        (("--read", __file__), "it should be a report of skyless selftest"),
    ],
)
def test_what_cannot_be_tested_is_said_in_one_line(options, words, capsys):
    assert main(["selftest", *options]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert words in said
