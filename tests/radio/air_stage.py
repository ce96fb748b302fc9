"""An ether whose time a test moves by hand, and clients without a network."""

import asyncio

from skyless.core.ticks import TICK_RATE_HZ, wrap
from skyless.radio.emulated import Join, Joined, Send
from skyless.run.ether import Ether
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.lab import lab_site
from skyless.sim.trajectory import Static

LAB = lab_site()
TAGS = {"tag1": Static(2.0, 3.0), "tag2": Static(4.0, 5.0)}


def make_ether(clock, seed=1, **faults):
    return Ether(LAB, TAGS, impairments_of(Request(LAB, **faults), LAB), seed, clock)


class Listener:
    """A client that writes down what it is told; ``deaf`` refuses it, as a full connection does."""

    def __init__(self):
        self.events = []
        self.deaf = False

    def send(self, message):
        if not self.deaf:
            self.events.append(message)
        return not self.deaf

    def of(self, kind):
        return [message for message in self.events if isinstance(message, kind)]


class Stage:
    """The lab's ether at a clock of the test's own."""

    def __init__(self, seed=1, **faults):
        self.now_s = 100.0
        self.ether = make_ether(lambda: self.now_s, seed, **faults)

    def pass_time(self, seconds, steps=20):
        for _ in range(steps):
            self.now_s += seconds / steps
            self.ether.advance()

    def join(self, kind, *names, tx_delays_ticks=()):
        """A client, and the one that is on the air, or why it is not."""
        client = Listener()
        return client, self.ether.join(client, Join(kind, names, tx_delays_ticks)) or client

    def ticks(self, client, node, ahead_s):
        """Counter of a client's node so far ahead, from what it was told when it joined."""
        joined = client.of(Joined)[-1]
        elapsed_s = self.now_s - joined.host_s + ahead_s
        return wrap(joined.ticks[node] + round(elapsed_s * TICK_RATE_HZ))

    def send(self, client, session, node=0, ahead_s=2e-3, frame=b"a frame" * 10):
        tx_ticks = self.ticks(client, node, ahead_s)
        self.ether.transmit(session, Send(node, tx_ticks, frame))
        return tx_ticks


def in_loop(play):
    """Run a test that needs an event loop, although its time stands still."""

    async def main():
        return play()

    return asyncio.run(main())
