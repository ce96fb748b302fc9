"""A site on emulated boards: ether, anchors and tags in one loop, with pseudo-terminals between them and radios."""

import asyncio
import contextlib
import time

import numpy as np
import pytest

from skyless.experiments.scenarios import Request, impairments_of
from skyless.experiments.warm import compile_kernels, compile_packet_kernels
from skyless.nodes.anchor import AnchorNode
from skyless.nodes.board import Board
from skyless.nodes.ether import Ether
from skyless.nodes.packet_tags import PacketTagNode, PacketTagSettings
from skyless.nodes.tag import TagNode, TagSettings
from skyless.radios.open import open_radios, open_sniffers
from skyless.radios.radio import AntennaDelays
from skyless.simulation.trajectory import Static
from skyless.site.lab import lab_site

LAB = lab_site()
PLACE_M = (2.0, 3.0, LAB.tags.height_m)
PLACES = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in LAB.anchors}
TAGS = ("tag1", "tag2", "tag3", "tag4")


class LiveSite:
    """What runs until the context ends; ``on_boards`` are anchors behind serial ports."""

    def __init__(self, folder):
        self.folder, self.said, self.published, self._tasks = folder, [], {}, {}
        standing = {name: Static(*PLACE_M[:2]) for name in TAGS}
        self.ether = Ether(LAB, standing, impairments_of(Request(LAB), LAB), 1)

    async def __aenter__(self):
        server = await self.ether.serve("127.0.0.1", 0)
        self.air = f"ether:127.0.0.1:{server.sockets[0].getsockname()[1]}"
        self.start("ether", self.ether.tell_clocks())
        return self

    async def __aexit__(self, *_):
        await asyncio.gather(*(self.stop(name) for name in list(self._tasks)))
        self.ether._timer.cancel()

    def start(self, name, work):
        self._tasks[name] = asyncio.ensure_future(work)

    async def stop(self, name):
        task = self._tasks.pop(name)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    def plug_in(self, name, speaks="link"):
        """A board; where its port is."""
        kind = "anchor" if name.isdecimal() else "tag"
        place = self.folder / name
        (radio,) = open_radios(self.air, kind, (name,))
        board = Board(radio, kind, speaks, place, self.said.append)
        self.start(f"board {name}", board.run())
        return board

    def anchor(self, number, radio):
        (one,) = open_radios(radio, "anchor", (str(number),), [AntennaDelays()])
        node = AnchorNode(LAB, number, one, self.said.append)
        self.start(f"anchor {number}", node.run())
        return node

    def tag(self, name, radio):
        fixes = self.published[name] = []
        if radio.startswith("sniffer"):
            settings = PacketTagSettings(PLACES, height_m=PLACE_M[2], publish_hz=1000.0)
            node = PacketTagNode(settings, open_sniffers(radio, (name,))[0], fixes.append, self.said.append)
        else:
            node = TagNode(
                TagSettings(publish_hz=1000.0), open_radios(radio, "tag", (name,))[0], fixes.append, self.said.append
            )
        self.start(name, node.run())
        return node

    async def until(self, true):
        async with asyncio.timeout(90):
            while not true():
                await asyncio.sleep(0.02)

    async def fixes(self, name, count):
        """So many further fixes; all but those of the first half second after the first."""
        fixes = self.published[name]
        begun = len(fixes)
        await self.until(lambda: len(fixes) >= begun + count and fixes[-1].unix_s > fixes[begun].unix_s + 1.0)
        return [fix for fix in fixes[begun:] if fix.unix_s > fixes[begun].unix_s + 0.5]


def are_right(fixes):
    """Fixes of a tag at rest: 2 cm each, so an rms of less than 6 cm; and none lies about it by ten deviations."""
    errors_m = np.linalg.norm([np.subtract(fix.position_m, PLACE_M) for fix in fixes], axis=1)
    stds_m = np.array([fix.std_m for fix in fixes])
    return len(fixes) > 20 and np.sqrt(np.mean(errors_m**2)) < 0.06 and (errors_m < 10.0 * stds_m).all()


@pytest.fixture(scope="module", autouse=True)
def compiled():
    compile_kernels()
    compile_packet_kernels()


def test_anchors_and_tags_on_boards_make_the_fixes_of_those_on_the_air_and_survive_pulled_plugs(tmp_path):
    async def play():
        async with LiveSite(tmp_path) as site:
            for number in (1, 2, 3):
                site.anchor(number, site.air)
            boards = {number: site.plug_in(str(number)) for number in (4, 5, 6)}
            anchors = {number: site.anchor(number, f"serial:{tmp_path / str(number)}") for number in boards}
            board = site.plug_in("tag1")
            node = site.tag("tag1", f"serial:{tmp_path / 'tag1'}")
            assert are_right(await site.fixes("tag1", 300))
            assert {4, 5, 6} & set(site.published["tag1"][-1].anchors)
            await site.until(lambda: all(one.speech.counts["sent"] > 20 for one in boards.values()))
            await site.until(lambda: node.radio._session.status and node.radio._session.status.received > 0)
            assert board.speech.counts["received"] >= node.receptions
            assert not node.radio.counters.keys() & {"malformed-record", "unknown-record", "copied-record"}

            await site.stop("board tag1")
            await site.until(lambda: any("pulled out" in line for line in site.said))
            told = len(site.published["tag1"])
            await asyncio.sleep(0.3)
            assert len(site.published["tag1"]) == told
            site.plug_in("tag1")
            assert are_right(await site.fixes("tag1", 300))
            assert node.restarts == 2

            await site.stop("board 4")
            await site.until(lambda: any("anchor 4" in line and "pulled out" in line for line in site.said))
            again = site.plug_in("4")
            await site.until(lambda: again.speech.counts["sent"] > 20)
            assert anchors[4].restarts == 2
            assert are_right(await site.fixes("tag1", 300))

    asyncio.run(play())


def test_a_frame_that_reaches_the_board_too_late_is_skipped_and_the_anchor_makes_its_frames_earlier(tmp_path):
    async def play():
        async with LiveSite(tmp_path) as site:
            board = site.plug_in("1")
            master = site.anchor(1, f"serial:{tmp_path / '1'}")
            await site.until(lambda: board.speech.counts["sent"] > 10)
            late, said = master.late, board.speech.hear_host

            def slowly(data):
                time.sleep(0.004)  # the host's bytes lie in a driver
                said(data)

            board.pty.start(slowly)
            await site.until(lambda: master.late > late)
            sent = board.speech.counts["sent"]
            await site.until(lambda: board.speech.counts["sent"] > sent + 10)
            assert board.speech.counts["late"] == master.late
            assert master.lead_s > 1.8e-3

    asyncio.run(play())


@pytest.mark.parametrize("speaks", ["sniffer", "sniffer-text", "listener"])
def test_boards_that_speak_other_people_s_formats_give_right_fixes(speaks, tmp_path):
    async def play():
        async with LiveSite(tmp_path) as site:
            for number in PLACES:
                site.anchor(number, site.air)
            site.plug_in("tag2", speaks)
            driver = speaks.partition("-")[0]
            node = site.tag("tag2", f"{driver}:{tmp_path / 'tag2'}")
            fixes = await site.fixes("tag2", 400)
            assert are_right(fixes)
            assert {fix.method for fix in fixes} == {"tracker" if driver == "listener" else "joint"}
            if driver == "sniffer":
                assert node.radio._stream._is_text is (speaks == "sniffer-text")
            await site.stop("board tag2")
            await site.until(lambda: any("pulled out" in line for line in site.said))
            site.plug_in("tag2", speaks)
            assert are_right(await site.fixes("tag2", 400))
            assert node.restarts == 2

    asyncio.run(play())
