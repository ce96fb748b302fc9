"""A simulated site with noisy fixes: no alarm missed, raised twice or without a cause, nothing acknowledged lost.

Tags walk in and out of a zone, fall silent and meet; what must be raised follows from their true ways alone. The page's
server may be killed at random moments. The time is simulated, so that broker and network, which add some milliseconds,
do not count.
"""

import random
from bisect import bisect_right
from collections import defaultdict
from itertools import pairwise

import pytest
from alarm_site import Site
from msgspec.structs import replace

from skyless.core.site import AlarmRule
from skyless.run.alarms import is_over
from skyless.run.mqtt.messages import Zone

SECONDS = 100.0
STEP_S = 0.1
STD_M = 0.01
SILENCE_S, LIMIT_M = 2.0, 2.0
COUNT = 6
"""Tags that walk, tags that fall silent, and pairs that meet."""
HALL = Zone("hall", "Hall", ((0.0, -10.0), (20.0, -10.0), (20.0, 900.0), (0.0, 900.0)))
WALKERS, SILENT, FIRSTS = (tuple(f"{letter}{k}" for k in range(COUNT)) for letter in "wsc")
RULES = [
    replace(rule, clear_after_s=0.5)
    for rule in (
        AlarmRule("nobody", "inside", zone="hall", tags=("group:none",)),
        AlarmRule("inside", "inside", zone="hall", tags=WALKERS),
        AlarmRule("outside", "outside", zone="hall", tags=WALKERS),
        AlarmRule("silent", "silent", tags=SILENT, after_s=SILENCE_S),
        AlarmRule("near", "near", limit=LIMIT_M, hysteresis=0.3, tags=FIRSTS),
    )
]


class World:
    """Tags whose state changes at random times, and by rule and subject the spans in which a condition holds."""

    def __init__(self, rng):
        self.rng, self.changes_s = rng, {}
        self.spans = {}
        for walker, silent, first in zip(WALKERS, SILENT, FIRSTS, strict=True):
            spans = self._spans(walker, (2.0, 6.0))
            self.spans["outside", walker], self.spans["inside", walker] = spans[::2], spans[1::2]
            self.spans["near", f"{first}~{first}b"] = self._spans(first, (2.0, 6.0))[::2]
            silences = self._spans(silent, (0.3, 1.6), (3.0, 8.0))[1::2]  # some are too short to count
            self.spans["silent", silent] = [(a + SILENCE_S, b) for a, b in silences if b - a > SILENCE_S]

    def _spans(self, name, *lengths_s):
        times_s = self.changes_s[name] = [0.0]
        while times_s[-1] < SECONDS:
            times_s.append(times_s[-1] + self.rng.uniform(*self.rng.choice(lengths_s)))
        return list(pairwise(times_s))

    def _beyond_m(self, name, at_s):
        """Tags go at 1 m/s and are on the line when their state changes; at first they are on its negative side."""
        times_s = self.changes_s[name]
        row = bisect_right(times_s, at_s)
        return (-1.0) ** row * min(1.5, at_s - times_s[row - 1], times_s[row] - at_s)

    def fixes(self, at_s):
        """Tags that send a fix now, and where it says that they are."""
        places = {}
        for k, (walker, silent, first) in enumerate(zip(WALKERS, SILENT, FIRSTS, strict=True)):
            places[walker] = self._beyond_m(walker, at_s), 5.0 * k
            places[first] = 0.0, 1000.0 + 10.0 * k
            places[f"{first}b"] = LIMIT_M + self._beyond_m(first, at_s), 1000.0 + 10.0 * k
            if self._beyond_m(silent, at_s) <= 0.0:
                places[silent] = 3.0, 3000.0 + 5.0 * k
        return [(tag, (self.rng.gauss(x, STD_M), self.rng.gauss(y, STD_M), 1.0)) for tag, (x, y) in places.items()]

    def published(self, *, kills):
        """What is published, with its time; servers are killed every ten seconds on the average, and start again."""
        kept, happened, site, starts_s = {}, [], None, 0.0
        for step in range(round(SECONDS / STEP_S)):
            at_s = step * STEP_S
            fixes = self.fixes(at_s)
            if site is None and at_s < starts_s:
                continue
            site = site or Site(*RULES, zones=(HALL,), kept=kept.values(), now_s=at_s)
            site.now_s = at_s
            for tag, place in fixes:
                site.send(tag, place)
            for one in kept.values():
                if self.rng.random() < 0.04:
                    site.engine.acknowledge(one.rule, one.subject, one.id, "Ada", site.unix_s)
            changes, dies = site.tick(), kills and self.rng.random() < STEP_S / 10.0
            for what, message in changes[: self.rng.randrange(len(changes) + 1) if dies else None]:
                happened.append((at_s, what, message))
                kept[message.rule, message.subject] = message
                if is_over(message):
                    del kept[message.rule, message.subject]
            if dies:
                site, starts_s = None, at_s + self.rng.uniform(0.1, 6.0)
        return happened

    def delays_s(self, happened):
        """How late alarms were raised, by rule, subject and number of the span."""
        found = defaultdict(list)
        for at_s, what, message in happened:
            if what == "raised":
                begins_s = [begin_s for begin_s, _ in self.spans[message.rule, message.subject]]
                row = bisect_right(begins_s, at_s + 0.3) - 1
                found[message.rule, message.subject, row].append(at_s - begins_s[row])
        return found


def test_every_crossing_silence_and_contact_is_raised_once_and_soon():
    world = World(random.Random(1))
    found = world.delays_s(world.published(kills=False))
    expected = {
        (*key, row)
        for key, spans in world.spans.items()
        for row, (begin_s, _) in enumerate(spans)
        if begin_s < SECONDS - 1.0
    }
    assert len(expected) > 150
    assert found.keys() >= expected
    assert all(len(times_s) == 1 and -0.3 <= times_s[0] <= 1.0 for times_s in found.values())


@pytest.mark.parametrize("seed", range(2))
def test_servers_killed_at_random_raise_nothing_twice_and_lose_no_acknowledgement(seed):
    world = World(random.Random(seed))
    happened = world.published(kills=True)
    assert max(map(len, world.delays_s(happened).values())) == 1
    acknowledged = set()
    for _, what, message in happened:
        acknowledged |= {message.id} if what == "acknowledged" else set()
        assert (message.acknowledged_unix_s is not None) == (message.id in acknowledged)
    assert len(acknowledged) > 30
