"""What the pages about other tools show: commands that the program knows, and targets that exist, with a picture."""

import re
import shlex
from pathlib import Path

import pytest
from test_readme import commands

from skyless.bridges.target import BridgeContext
from skyless.bridges.targets import TARGET_KINDS, open_route
from skyless.cli.main import program

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs" / "tools").glob("*.md"))
INDEX = ROOT / "docs" / "tools" / "index.md"


def own_commands(page):
    """The lines of a page's shell blocks that call the program."""
    return [shlex.split(line)[1:] for line in commands(page) if line.startswith("skyless ")]


def targets(page):
    """Every target in a page's commands, or in its text as code."""
    text = page.read_text(encoding="utf-8")
    schemes = "|".join(re.escape(scheme) for scheme in TARGET_KINDS)
    return set(re.findall(rf"(?<![\w+])((?:{schemes}):[^\s`'\"),\]]*)", text))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_are_known_to_the_program(page):
    for command in own_commands(page):
        program().parse_args(command, print_error=False, exit_on_error=False)


@pytest.mark.site
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_targets_can_be_opened(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    node = tmp_path / "lib" / "skyless_ros2" / "node"
    node.parent.mkdir(parents=True)
    node.touch(0o755)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    for text in sorted(targets(page)):
        if any(letters in text for letters in ("HOST", "PORT", "PATH", "[", "192.168.")) or text.endswith((":", "://")):
            continue  # how such an address is made up
        open_route(text, BridgeContext(print))


@pytest.mark.parametrize("page", [page for page in PAGES if page != INDEX], ids=lambda page: page.stem)
def test_a_page_shows_what_comes_out(page):
    shown = re.search(r"!\[[^\]]+\]\(\.\./pictures/|```json", page.read_text(encoding="utf-8"))
    assert shown, "a picture or a message is missing"


def test_every_target_is_in_the_table_of_all():
    text = INDEX.read_text(encoding="utf-8")
    assert [scheme for scheme in TARGET_KINDS if f"`{scheme}:" not in text] == []
    linked = set(re.findall(r"\]\((\w+\.md)\)", text))
    assert linked == {page.name for page in PAGES} - {"index.md"}
