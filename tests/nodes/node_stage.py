"""Nodes without processes: a radio that the test plays, and an event loop whose time jumps from timer to timer."""

import asyncio
import selectors
from collections import Counter

from msgspec.structs import replace

from skyless.air.reception import Reception
from skyless.anchor import Anchor
from skyless.constants import TICK_RATE_HZ
from skyless.evaluation.scenarios import Request, impairments_of
from skyless.radios.interface import Sent
from skyless.simulation.stations import TagSpec
from skyless.simulation.trajectory import Static
from skyless.simulation.world import World
from skyless.site.lab import ideal_lab_site
from skyless.ticks import difference, wrap

LAB = ideal_lab_site()
PLACE_M = (2.0, 3.0, 0.0)


class JumpingLoop(asyncio.SelectorEventLoop):
    """Never waits: its time is that of the next timer."""

    def __init__(self):
        self.now_s = 1000.0

        class Jumping(selectors.SelectSelector):
            def select(_, timeout=None):  # noqa: N805
                assert timeout is not None, "nothing is planned any more"
                self.now_s += max(timeout, 0.0)
                return selectors.SelectSelector.select(_, 0)

        super().__init__(Jumping())

    def time(self):
        return self.now_s


def play(main):
    """Run a test in a loop that jumps."""
    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        runner.run(main)


LEAD_S = 1.8e-3


class FakeRadio:
    """What a node asks of a radio; events are what the test says."""

    def __init__(self, name="1", begin_ticks=2**40 - 10**9):
        self.name = name
        self.counters = Counter()
        self.lead_s = LEAD_S
        self.ready = True
        self.begin_ticks = begin_ticks
        """The counter at the loop's 1000 s; it soon wraps."""
        self.transmissions = []
        """Time and transmission."""
        self.sends = False
        """Whether it says of each frame that it was sent, once it was."""

    async def run(self, listener):
        self.listener = listener
        await asyncio.Event().wait()

    def advice(self):
        return "the radio says where to look"

    def now_ticks(self):
        if not self.ready:
            return None
        return self.ticks_at(self.loop_s())

    def ticks_at(self, loop_s):
        return wrap(self.begin_ticks + round((loop_s - 1000.0) * TICK_RATE_HZ))

    def loop_s(self):
        return asyncio.get_running_loop().time()

    def transmit(self, transmission):
        self.transmissions.append((self.loop_s(), transmission))
        if self.sends:
            ahead_s = difference(transmission.tx_ticks, self.now_ticks()) / TICK_RATE_HZ
            asyncio.get_running_loop().call_later(ahead_s + 0.1e-3, self.listener, Sent(transmission.tx_ticks))


def receptions(seconds, seed=1):
    """What a tag at ``PLACE_M`` hears in the simulated lab."""
    return receptions_of(LAB.id, seconds, seed=seed)


def undated(heard):
    """Receptions of a radio that does not know when they came, so that none is too old."""
    return [Reception(reception.frame, reception.rx_ticks, None, reception.diagnostics) for reception in heard]


def receptions_of(site_id, seconds, *, later_s=0.0, seed=1):
    """The same of a lab with another identifier on the air, and so much later by the host's clock and the counter."""
    site = replace(LAB, id=site_id)
    faults = impairments_of(Request(site), site)
    world = World(site, lambda anchor: Anchor(site, anchor), [TagSpec(Static(*PLACE_M))], faults, seed)
    heard = [reception for broadcast in world.run(seconds) for _, reception, _ in broadcast.receptions()]
    later_ticks = round(later_s * TICK_RATE_HZ)
    return [Reception(r.frame, wrap(r.rx_ticks + later_ticks), r.host_s + later_s, r.diagnostics) for r in heard]
