"""Anchors and a tag whose radio is the firmware, from the host's programs over pseudo-terminals to the emulated air."""

import asyncio
import random

import pytest
from firmware_board import FirmwareBoard
from live_nodes import LiveSite, are_right

from skyless.evaluation.compile_ahead import compile_kernels
from skyless.firmware.board import NO_FRAME


@pytest.fixture(scope="module", autouse=True)
def compiled():
    compile_kernels()


def plug_in(site, name):
    kind = "anchor" if name.isdecimal() else "tag"
    board = FirmwareBoard(site.air, kind, name, site.folder / name)
    site.start(f"board {name}", board.run())
    return board


def test_anchor_and_tag_on_the_firmware_make_right_fixes_and_survive_noise_and_pulled_plugs(tmp_path):
    async def play():
        async with LiveSite(tmp_path) as site:
            for number in (1, 2, 3, 5):
                site.anchor(number, site.air)
            anchor_board = plug_in(site, "4")
            anchor = site.anchor(4, f"serial:{tmp_path / '4'}")
            tag_board = plug_in(site, "tag1")
            node = site.tag("tag1", f"serial:{tmp_path / 'tag1'}")
            assert are_right(await site.fixes("tag1", 200))
            await site.until(lambda: anchor_board.board._chip.sent > 20)
            assert not +anchor_board.chip.misuse
            assert not +tag_board.chip.misuse
            assert not node.radio.counters.keys() & {"malformed-record", "unknown-record", "copied-record"}

            noise = random.Random(1)  # on the way to the board: it hears all of it, and goes on
            for _ in range(100):
                tag_board.came.extend(noise.randbytes(noise.randrange(1, 200)))
                await asyncio.sleep(0.002)
            await site.until(lambda: node.radio._session.status.garbled > 15)
            assert are_right(await site.fixes("tag1", 200))

            await site.stop("board tag1")
            await site.until(lambda: any("unplugged" in line for line in site.said))
            plug_in(site, "tag1")
            assert are_right(await site.fixes("tag1", 200))
            assert node.monitor.restarts == 2

            await site.stop("anchor 4")  # the host vanishes, and comes back
            await asyncio.sleep(0.5)
            await site.until(lambda: anchor_board.board._stage == NO_FRAME)
            sent = anchor_board.board._chip.sent
            await asyncio.sleep(0.3)
            assert anchor_board.board._chip.sent == sent
            site.anchor(4, f"serial:{tmp_path / '4'}")
            await site.until(lambda: anchor_board.board._chip.sent > sent + 20)
            assert anchor.monitor.restarts == 1
            assert not +anchor_board.chip.misuse

    asyncio.run(play())
