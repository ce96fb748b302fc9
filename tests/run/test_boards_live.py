"""A site on emulated boards: ether, anchors and tags in one loop, with pseudo-terminals between them and radios."""

import asyncio
import time

import pytest
from live_nodes import PLACES, LiveSite, are_right

pytestmark = pytest.mark.live


async def test_anchors_and_tags_on_boards_make_the_fixes_of_those_on_the_air_and_survive_pulled_plugs(tmp_path):
    async with LiveSite(tmp_path) as site:
        for number in (1, 2, 3):
            site.anchor(number, site.air)
        boards = {number: site.plug_in(str(number)) for number in (4, 5, 6)}
        anchors = {number: site.anchor(number, f"serial:{tmp_path / str(number)}") for number in boards}
        board = site.plug_in("tag1")
        node = site.tag("tag1", f"serial:{tmp_path / 'tag1'}")
        assert are_right(await site.fixes("tag1", 300))
        assert {4, 5, 6} & set(site.published["tag1"][-1].anchors)
        await site.until(lambda: all(one.protocol.counts["sent"] > 20 for one in boards.values()))
        await site.until(lambda: node.radio._session.status and node.radio._session.status.received > 0)
        assert board.protocol.counts["received"] >= node.receptions
        assert not node.radio.counters.keys() & {"malformed-record", "unknown-record", "copied-record"}

        await site.stop("board tag1")
        await site.until(lambda: any("unplugged" in line for line in site.said))
        before = len(site.published["tag1"])
        await asyncio.sleep(0.3)
        assert len(site.published["tag1"]) == before
        site.plug_in("tag1")
        assert are_right(await site.fixes("tag1", 300))
        assert node.monitor.restarts == 2

        await site.stop("board 4")
        await site.until(lambda: any("anchor 4" in line and "unplugged" in line for line in site.said))
        again = site.plug_in("4")
        await site.until(lambda: again.protocol.counts["sent"] > 20)
        assert anchors[4].monitor.restarts == 2
        assert are_right(await site.fixes("tag1", 300))


async def test_a_frame_that_reaches_the_board_too_late_is_skipped_and_the_anchor_makes_its_frames_earlier(tmp_path):
    async with LiveSite(tmp_path) as site:
        board = site.plug_in("1")
        master = site.anchor(1, f"serial:{tmp_path / '1'}")
        await site.until(lambda: board.protocol.counts["sent"] > 10)
        late, said = master.late, board.protocol.on_host_data

        def slowly(data):
            time.sleep(master.radio.lead_s)  # the host's bytes lie in a driver
            said(data)

        board.pty.start(slowly)
        await site.until(lambda: master.late > late)
        sent = board.protocol.counts["sent"]
        await site.until(lambda: board.protocol.counts["sent"] > sent + 10)
        await site.until(lambda: board.protocol.counts["late"] == master.late)  # none is on its way to the host
        assert master.lead_s > master.radio.lead_s


@pytest.mark.parametrize("speaks", ["sniffer", "sniffer-text", "listener", "uci", "uci-2"])
async def test_boards_of_other_formats_give_right_fixes(speaks, tmp_path):
    async with LiveSite(tmp_path) as site:
        for number in PLACES:
            site.anchor(number, site.air)
        site.plug_in("tag2", speaks)
        driver = speaks.partition("-")[0]
        node = site.tag("tag2", f"{driver}:{tmp_path / 'tag2'}")
        fixes, most_m = await site.fixes("tag2", 400), 0.25 if driver == "uci" else 0.06
        assert are_right(fixes, most_m)
        assert {fix.method for fix in fixes} == {"joint"}
        if driver == "sniffer":
            assert node.radio._stream._is_text is (speaks == "sniffer-text")
        await site.stop("board tag2")
        await site.until(lambda: any("unplugged" in line for line in site.said))
        site.plug_in("tag2", speaks)
        assert are_right(await site.fixes("tag2", 400), most_m)
        assert node.monitor.restarts == 2
