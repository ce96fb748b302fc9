"""A site in one loop: ether, anchors and tags, with pseudo-terminals between them and boards."""

import asyncio
import contextlib

import numpy as np

from skyless.radio.interface import AntennaDelays
from skyless.run.anchor import AnchorNode
from skyless.run.board import Board
from skyless.run.ether import Ether
from skyless.run.masterless.packet_tags import PacketTagNode, PacketTagSettings
from skyless.run.open_radio import open_radios, open_sniffers
from skyless.run.tag import TagNode, TagSettings
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.lab import paper_lab_site
from skyless.sim.trajectory import Static
from support.waiting import until

LAB = paper_lab_site()
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
        self.start("ether", self.ether.send_clocks())
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
        if radio.startswith(("sniffer", "uci")):
            known = {"auto_height": True} if radio.startswith("uci") else {"height_m": PLACE_M[2]}
            settings = PacketTagSettings({} if radio.startswith("uci") else PLACES, publish_hz=1000.0, **known)
            node = PacketTagNode(settings, open_sniffers(radio, (name,))[0], fixes.append, self.said.append)
        else:
            node = TagNode(
                TagSettings(publish_hz=1000.0), open_radios(radio, "tag", (name,))[0], fixes.append, self.said.append
            )
        self.start(name, node.run())
        return node

    async def until(self, true):
        await until(true, 90.0)

    async def fixes(self, name, count):
        """So many further fixes; all but those of the first half second after the first."""
        fixes = self.published[name]
        begun = len(fixes)
        await self.until(lambda: len(fixes) >= begun + count and fixes[-1].unix_s > fixes[begun].unix_s + 1.0)
        return [fix for fix in fixes[begun:] if fix.unix_s > fixes[begun].unix_s + 0.5]


def are_right(fixes, most_m=0.06):
    """Fixes of a tag at rest: 2 cm each, so an rms of less than 6 cm; and none lies about it by ten deviations.

    A tag that assumes errors of ranges and survey settles with that of its first fixes: 4 to 7 cm.
    """
    errors_m = np.linalg.norm([np.subtract(fix.position_m, PLACE_M) for fix in fixes], axis=1)
    stds_m = np.array([fix.std_m for fix in fixes])
    return len(fixes) > 20 and np.sqrt(np.mean(errors_m**2)) < most_m and (errors_m < 10.0 * stds_m).all()
