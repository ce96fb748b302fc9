"""Watches a running site over MQTT and judges every fix that it publishes."""

import asyncio
import bisect
import itertools
import time
from collections import defaultdict, deque

import msgspec

from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import AnchorHealth, EtherHealth, FixMessage, StatusMessage, TagHealth, TruthMessage
from skyless.run.mqtt.topics import fix_topic, health_topic, status_topic, truth_topic
from skyless.sim.evaluation.scenarios import COMFORT_MPS2
from support.mqtt_brokers import stopped

NEAR_S = 0.06
"""A truth is known from a message so near in time; an ether sends one every 50 ms."""

TIME_ERROR_M = 2e-3
"""The tags walk at 1 m/s. A fix holds when its frame's RMARKER was heard, 0.2 ms before ``unix_s``, and processes look
at the wall clock once a second: together less than 2 ms."""

STALL_S = 0.3
KEPT_S = 20.0

HEALTHS = {"tag": TagHealth, "anchor": AnchorHealth, "ether": EtherHealth}


class Observer:
    """Subscribes to fixes, truth, health and statuses."""

    def __init__(self, address, site):
        self.link = Link(address, "observer", site=site, kind="watch")
        self.good = defaultdict(deque)
        """For each tag: when it was made (monotonic) and fix, of those found right; a busy machine brings them late."""
        self.false = []
        self.judged = self.unjudged = 0
        self.health = {}
        """By kind and name: arrival and message."""
        self.statuses = []
        """Arrival, kind, name, online."""
        self.stalls = []
        """When this process itself stood still: begin and length."""
        self._waiting = deque()
        self._truth_s, self._truths = [], []
        self._fix = msgspec.json.Decoder(FixMessage)
        self._truth = msgspec.json.Decoder(TruthMessage)
        self.link.subscribe(fix_topic(site, "+"), self._take_fix)
        self.link.subscribe(truth_topic(site), self._take_truth)
        self.link.subscribe(status_topic(site, "+", "+"), self._take_status)
        self.link.subscribe(health_topic(site, "+", "+"), self._take_health)

    def _take_fix(self, topic, payload):
        self._waiting.append((time.monotonic(), self._fix.decode(payload)))

    def _take_truth(self, topic, payload):
        truth = self._truth.decode(payload)
        self._truth_s.append(truth.unix_s)
        self._truths.append(truth)

    def _take_status(self, topic, payload):
        status = msgspec.json.decode(payload, type=StatusMessage)
        self.statuses.append((time.monotonic(), status.kind, status.name, status.online))

    def _take_health(self, topic, payload):
        _, _, _, kind, name, _ = topic.split("/")
        self.health[kind, name] = time.monotonic(), msgspec.json.decode(payload, type=HEALTHS[kind])

    async def run(self):
        link = asyncio.ensure_future(self.link.run())
        try:
            last_s = time.monotonic()
            while True:
                await asyncio.sleep(0.02)
                now_s = time.monotonic()
                if now_s - last_s > STALL_S:
                    self.stalls.append((last_s, now_s - last_s))
                last_s = now_s
                self._judge_waiting(now_s)
        finally:
            await stopped(link)

    def _judge_waiting(self, now_s):
        """Judge fixes once the truth after them is known, or will not come any more."""
        later = deque()
        while self._waiting:
            arrived_s, fix = self._waiting.popleft()
            known = self._truth_s and self._truth_s[-1] >= fix.unix_s
            if known or now_s - arrived_s > 2.0:
                self._judge(arrived_s, fix)
            else:
                later.append((arrived_s, fix))
        self._waiting = later
        while self._truth_s and self._truth_s[0] < time.time() - KEPT_S:
            del self._truth_s[0], self._truths[0]

    def _judge(self, arrived_s, fix):
        nearest = self._nearest_truth(fix.unix_s)
        if nearest is None or fix.tag not in nearest.tags:
            self.unjudged += 1
            return
        self.judged += 1
        gap_s = fix.unix_s - nearest.unix_s
        motion = nearest.tags[fix.tag]
        true_m = [place + gap_s * speed for place, speed in zip(motion.position_m, motion.velocity_mps, strict=True)]
        error_m = sum((have - true) ** 2 for have, true in zip(fix.position_m, true_m, strict=True)) ** 0.5
        # a straight line from the nearest message strays from a path of that acceleration by no more than this
        allowed_m = TIME_ERROR_M + 0.5 * COMFORT_MPS2 * gap_s**2
        if error_m > 6.0 * fix.std_m + allowed_m:
            self.false.append((arrived_s, error_m, fix))
        else:
            self.good[fix.tag].append((fix.unix_s - time.time() + time.monotonic(), fix))

    def _nearest_truth(self, unix_s):
        index = bisect.bisect_left(self._truth_s, unix_s)
        near = [truth for truth in self._truths[max(index - 1, 0) : index + 1] if abs(truth.unix_s - unix_s) < NEAR_S]
        return min(near, key=lambda truth: abs(truth.unix_s - unix_s), default=None)

    def made(self, tag, since_s):
        """When right fixes were made since then."""
        return [made_s for made_s, _ in self.good[tag] if made_s >= since_s]

    async def recovery_s(self, tags, since_s, limit_s=5.0):
        """How long after a time all these tags had right fixes again, made since then, and go on having them.

        That is, at least ten in the half second after the first; infinite where that does not come to pass.
        """
        while time.monotonic() < since_s + limit_s:
            began = [self._steady_since(tag, since_s) for tag in tags]
            if None not in began:
                return max(began) - since_s
            await asyncio.sleep(0.02)
        return float("inf")

    def _steady_since(self, tag, since_s):
        made = self.made(tag, since_s)
        for tenth, begin_s in zip(made[9:], made, strict=False):
            if tenth - begin_s <= 0.5:
                return begin_s
        return None

    def longest_silence_s(self, tag, since_s, until_s):
        """The longest time in which no right fix was made."""
        times = [since_s, *(s for s in self.made(tag, since_s) if s < until_s), until_s]
        return max(later - earlier for earlier, later in itertools.pairwise(times))

    def online(self, kind, name, since_s=0.0):
        """What was said of a node's status since then, in order."""
        return [on for at_s, *node, on in self.statuses if node == [kind, str(name)] and at_s >= since_s]

    def clock_offset_s(self, tag):
        """A tag's site time less the wall clock, median of its last 20 right fixes."""
        offsets = sorted(fix.time_s - fix.unix_s for _, fix in list(self.good[tag])[-20:])
        return offsets[len(offsets) // 2]

    def masters(self):
        """Anchors that call themselves master in their last health message."""
        return [
            health.anchor
            for (kind, _), (_, health) in self.health.items()
            if kind == "anchor" and health.role == "master"
        ]

    def term(self):
        """How often the master's role has gone to another."""
        return max(health.term for (kind, _), (_, health) in self.health.items() if kind == "anchor")

    def ether_stalls(self):
        return self.health["ether", "air"][1].stalls
