"""``skyless anchor`` and ``skyless tag`` by their command lines, on a whole site of boards in virtual time."""

import asyncio

import msgspec
import pytest
from emulator.site.emulated_site import EmulatedSite
from site_stage import HOST, boards, wire_of

from skyless.cli.main import main, program
from skyless.run import process
from skyless.run.mqtt.messages import FixMessage
from skyless.sim.trajectory import Static
from skyless.site.file.load import load_site

pytestmark = pytest.mark.site

PATHS = [Static(2.0, 3.0, 0.0)]
SECONDS = 1.0


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A site file as ``skyless site new`` writes it."""
    path = tmp_path_factory.mktemp("site") / "hall.toml"
    assert main(["site", "new", str(path), "--width", "6", "--depth", "8"]) == 0
    return path


@pytest.mark.parametrize("kind", [HOST])
@pytest.mark.statistical
def test_the_commands_give_the_fixes_that_their_classes_give(kind, file, capfd, monkeypatch):
    """A command runs its program on a loop of its own, until Ctrl-C; here it gives it to the site's loop instead."""
    site = load_site(file)
    of_classes = EmulatedSite(site, PATHS, boards(kind), wire=wire_of(kind))
    of_classes.run(SECONDS)
    capfd.readouterr()
    given = []
    monkeypatch.setattr(process, "run", lambda main, **_: given.append(main))

    class OfCommands(EmulatedSite):
        def start_host(self, node):
            is_anchor = node in self.anchors
            words = ["anchor", node.name, "--site", file] if is_anchor else ["tag", node.name, "--json"]
            words += [] if is_anchor else ["--publish-hz", "1000"]
            program()([*map(str, words), "--radio", f"serial:{node.wire.path}", "--mqtt", "none"])
            node.task = asyncio.ensure_future(given.pop())

    of_commands = OfCommands(site, PATHS, boards(kind), wire=wire_of(kind))
    of_commands.run(SECONDS)
    printed, said = capfd.readouterr()
    fixes = [msgspec.json.decode(line, type=FixMessage) for line in printed.splitlines()]
    assert len(fixes) > 20
    assert fixes == [fix for fix, _ in of_classes.fixes["tag1"]]
    assert of_commands.sent == of_classes.sent
    assert all(f"anchor {anchor.id}" in said for anchor in site.anchors)
