"""``skyless paper``: what it writes, and that it holds together; a report far smaller than the quick one."""

import json
import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest

from skyless.cli.main import main
from skyless.research.paper import plan as plans
from skyless.research.paper import run
from skyless.research.paper.claims import QUANTITIES
from skyless.research.paper.plan import Plan

pytestmark = pytest.mark.statistical

TINY = Plan(
    seed=3,
    quick=True,
    fixes=600,
    fewer_fixes=600,
    noises_ps=(50.0, 100.0, 150.0),
    laps=1,
    fleet_sizes=(1, 3),
    rate_s=1.0,
    draws=20_000,
)
VOID = {"meta", "link", "br", "img", "input", "hr"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A report in a folder where a file of another's lies, and the command's JSON."""
    folder = tmp_path_factory.mktemp("paper") / "report"
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    with pytest.MonkeyPatch.context() as patch, pytest.MonkeyPatch.context() as output:
        lines = []
        patch.setattr(plans, "plan_of", lambda seed, *, quick: TINY)
        output.setattr("builtins.print", lambda *words, **_: lines.append(" ".join(map(str, words))))
        assert main(["paper", "--out", str(folder), "--seed", "3", "--quick", "--json"]) == 0
    return folder, json.loads(lines[-1])


class Page(HTMLParser):
    """Reads a page strictly: every element that opens closes, in the right order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.links, self.tags = [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.handle_startendtag(tag, attributes)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append(tag)
        names = [name for name, _ in attributes]
        assert len(names) == len(set(names)), f"an attribute twice in {tag}: {names}"
        for name, value in attributes:
            if name == "id":
                self.ids.append(value)
            if name in {"href", "src", "xlink:href"}:
                self.links.append(value)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f"{tag} closes out of turn at {self.getpos()}"


@pytest.mark.statistical
def test_every_picture_is_there_twice_and_nothing_is_left_over(made):
    folder, printed = made
    assert all(section["pictures"] for section in printed["sections"])
    assert len(printed["figures"]) == 2 * sum(len(section["pictures"]) for section in printed["sections"])
    for path in printed["figures"]:
        data = (folder / path.rsplit("/", 1)[-1]).read_bytes()
        if path.endswith(".png"):
            assert data.startswith(b"\x89PNG")
        else:
            assert ElementTree.fromstring(data).tag.endswith("svg")
    expected = {path.rsplit("/", 1)[-1] for path in printed["figures"]} | {"report.html", "numbers.json", "notes.txt"}
    assert {file.name for file in folder.iterdir()} == expected
    assert [entry.name for entry in folder.parent.iterdir()] == [folder.name]


def test_the_page_is_valid_and_needs_nothing_else(made):
    folder, printed = made
    text = (folder / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert len(page.ids) == len(set(page.ids))
    for link in page.links:
        assert link.startswith("data:") or link[1:] in page.ids, link
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    assert not re.search(r"https?://", text)
    assert all(target in page.ids for target in re.findall(r"url\(#([^)]*)\)", text))
    assert page.tags.count("svg") == len(printed["figures"]) // 2
    for section in printed["sections"]:
        assert section["key"] in page.ids
        assert section["label"] in text


def test_the_printed_numbers_are_those_written(made):
    folder, printed = made
    written = json.loads((folder / "numbers.json").read_bytes())
    assert {key: printed[key] for key in written} == written
    assert len(printed["sections"]) == 10
    assert printed["sections"][0]["key"] == "scenario"
    names = {check["name"] for check in printed["checks"]}
    assert len(names) == 2 * 10 * len(QUANTITIES)
    for check in printed["checks"]:
        assert check["draws"] == TINY.draws
        assert check["corrected_error_pct"] < 5.0 * check["standard_error_pct"]


def test_verdicts_are_those_of_the_long_report(made):
    """Even so few draws and fixes tell the paper's errata and limits from what is right."""
    verdicts = {section["key"]: section["verdict"] for section in made[1]["sections"]}
    assert (
        verdicts["scenario"] == verdicts["update-rate"] == verdicts["three-receivers"] == verdicts["scaling"] == "holds"
    )
    assert verdicts["gamma-check"] == verdicts["largest-error"] == verdicts["pdop-map"] == "holds with a correction"


def test_updates_come_at_the_rates_of_the_schedule(made):
    (section,) = (section for section in made[1]["sections"] if section["key"] == "update-rate")
    rates = {(count["site"][:3], count["method"]): count["updates"] for count in section["numbers"]["counts"]}
    for key, per_s in {
        ("six", "literal"): 1 / 15e-3,
        ("six", "joint"): 400.0,
        ("sev", "literal"): 1 / 14.7033e-3,
        ("sev", "joint"): 476.07,
    }.items():
        assert abs(rates[key] - per_s * TINY.rate_s) <= 1.0, key


def test_biased_stamps_move_the_mean_where_theory_says(made):
    (section,) = (section for section in made[1]["sections"] if section["key"] == "static-errors")
    rows = [row for row in section["numbers"]["rows"] if row["method"] == "literal"]
    assert len(rows) == 6
    for row in rows:
        for axis, expected_m in zip("xy", row["expected_bias_m"], strict=True):
            # 4.5 standard errors over 12 means; 2 mm for the second order of biases of some centimetres
            assert abs(row[axis]["mean_m"] - expected_m) < 4.5 * row[axis]["mean_standard_error_m"] + 2e-3


@pytest.mark.parametrize("below", ["", "/deeper"])
def test_a_file_is_no_place_for_a_report(tmp_path, complaint, below):
    (tmp_path / "taken").write_text("mine")
    printed = complaint("paper", "--out", f"{tmp_path}/taken{below}", "--quick")
    assert "--out" in printed
    assert "taken" in printed
    assert (tmp_path / "taken").read_text() == "mine"


@pytest.mark.statistical
def test_an_interrupt_leaves_nothing_behind(tmp_path):
    def interrupt(done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run.write_report(TINY, tmp_path / "report", interrupt)
    assert not list(tmp_path.iterdir())
