"""Nodes without processes: a radio that the test plays, and an event loop whose time jumps from timer to timer."""

import asyncio
import contextlib
import functools
import selectors
from collections import Counter
from typing import ClassVar

import msgspec
from msgspec.structs import replace

from skyless.core.air.frame import Reception
from skyless.core.protocol1.anchor import Anchor
from skyless.core.ticks import TICK_RATE_HZ, difference, wrap
from skyless.radio.interface import Restarted, Sent
from skyless.run.anchor import AnchorNode
from skyless.run.mqtt.messages import Counters
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.lab import paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World
from support.waiting import running

LAB = paper_lab_site()
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


def played(test):
    """Run a coroutine of a test in a loop that jumps."""

    @functools.wraps(test)
    def run(*arguments, **fixtures):
        with asyncio.Runner(loop_factory=JumpingLoop) as runner:
            runner.run(test(*arguments, **fixtures))

    return run


class FakeLink:
    """A link to no broker: a test calls its handlers, and reads what was published."""

    made: ClassVar = []
    """All links since the fixture ``links`` began."""

    def __init__(self, address=None, name=None, *, site=None, kind=None, **_):
        self.address, self.name, self.site, self.kind = address, name, site, kind
        self.counters, self.late, self.state = Counters(0, 0, 0), 0, "made"
        self.handlers, self.published, self.forgotten, self.on_state = {}, [], [], []
        FakeLink.made.append(self)

    def subscribe(self, topic, handler, qos=0):
        self.handlers[topic] = handler

    def publish(self, topic, message, **options):
        self.published.append((topic, message, options))

    def forget(self, topic):
        self.forgotten.append(topic)

    async def run(self):
        self.state = "running"
        try:
            await asyncio.Event().wait()
        finally:
            self.state = "left"

    def receive(self, topic, message):
        """A message comes, of a topic or of the end of one that is subscribed to."""
        payload = message if isinstance(message, bytes) else msgspec.json.encode(message)
        ((name, handler),) = [one for one in self.handlers.items() if one[0].endswith(topic)]
        own_name = getattr(message, "tag", None) or str(getattr(message, "anchor", 1))
        handler(name.replace("+", own_name), payload)

    def newest(self, kind):
        return next((message for _, message, _ in reversed(self.published) if isinstance(message, kind)), None)


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


def receptions(seconds, seed=1, **faults):
    """What a tag at ``PLACE_M`` hears in the simulated lab."""
    return receptions_of(LAB.id, seconds, seed=seed, **faults)


def undated(heard):
    """Receptions of a radio that does not know when they came, so that none is too old."""
    return [Reception(reception.frame, reception.rx_ticks, None, reception.diagnostics) for reception in heard]


def receptions_of(site_id, seconds, *, later_s=0.0, seed=1, **faults):
    """The same of a lab with another identifier on the air, and so much later by the host's clock and the counter."""
    site = replace(LAB, id=site_id)
    air = impairments_of(Request(site, **faults), site)
    world = World(site, lambda anchor: Anchor(site, anchor), [TagSpec(Static(*PLACE_M))], air, seed)
    heard = [reception for broadcast in world.run(seconds) for _, reception, _ in broadcast.receptions()]
    later_ticks = round(later_s * TICK_RATE_HZ)
    return [replace(r, rx_ticks=wrap(r.rx_ticks + later_ticks), host_s=r.host_s + later_s) for r in heard]


@contextlib.asynccontextmanager
async def running_anchor(site=LAB, anchor=1, seconds=0.0, *, sends=True):
    """An anchor that receives nobody, some time after its radio became ready: node, radio and what it logged."""
    radio, logged = FakeRadio(str(anchor)), []
    radio.sends = sends
    node = AnchorNode(site, anchor, radio, logged.append)
    async with running(node.run()):
        node.on_event(Restarted())
        await asyncio.sleep(seconds)
        yield node, radio, logged
