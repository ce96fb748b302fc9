"""Nodes without processes: a radio that the test plays, and an event loop whose time jumps from timer to timer."""

import asyncio
import selectors

from skyless.anchor import Anchor
from skyless.constants import TICK_RATE_HZ
from skyless.experiments.scenarios import Request, impairments_of
from skyless.radios.radio import Sent
from skyless.simulation.stations import TagSpec
from skyless.simulation.trajectory import Static
from skyless.simulation.world import World
from skyless.site.lab import lab_site
from skyless.ticks import difference, wrap

LAB = lab_site()
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


class FakeRadio:
    """What a node asks of a radio; events are what the test says."""

    def __init__(self, name="1", begin_ticks=2**40 - 10**9):
        self.name = name
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

    def now_ticks(self):
        if not self.ready:
            return None
        return wrap(self.begin_ticks + round((self.loop_s() - 1000.0) * TICK_RATE_HZ))

    def loop_s(self):
        return asyncio.get_running_loop().time()

    def transmit(self, transmission):
        self.transmissions.append((self.loop_s(), transmission))
        if self.sends:
            ahead_s = difference(transmission.tx_ticks, self.now_ticks()) / TICK_RATE_HZ
            asyncio.get_running_loop().call_later(ahead_s + 0.1e-3, self.listener, Sent(transmission.tx_ticks))


def receptions(seconds, seed=1):
    """What a tag at ``PLACE_M`` hears in the simulated lab."""
    world = World(LAB, lambda anchor: Anchor(LAB, anchor), [TagSpec(Static(*PLACE_M))], faults(), seed)
    return [reception for broadcast in world.run(seconds) for _, reception, _ in broadcast.receptions()]


def faults():
    return impairments_of(Request(LAB), LAB)
