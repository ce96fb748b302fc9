"""A simulated site with noisy fixes: no alarm missed, raised twice or without a cause, nothing acknowledged lost.

Tags walk in and out of a zone, fall silent and meet; what must be raised follows from their true ways alone. The page's
server may be killed at random moments. The time is simulated, so that broker and network, which add some milliseconds,
do not count.
"""

import math
import random
from bisect import bisect_right
from collections import defaultdict
from itertools import pairwise
from operator import itemgetter

import numpy as np
import pytest
from alarm_site import Site
from msgspec.structs import replace

from skyless.core.site import AlarmRule
from skyless.run.alarms import is_over
from skyless.run.mqtt.messages import Zone

pytestmark = pytest.mark.site

SECONDS = 100.0
TICK_S = 0.05
INTERVAL_S = 0.1
STD_M = 0.01
SILENCE_S = 2.0
COUNT = 6
"""Tags that walk, tags that fall silent, and pairs that meet."""
WALKERS, SILENT, FIRSTS = (tuple(f"{letter}{k}" for k in range(COUNT)) for letter in "wsc")
ZONES = (Zone("hall", "Hall", ((0.0, -10.0), (20.0, -10.0), (20.0, 900.0), (0.0, 900.0))),)
RULES = [
    replace(rule, clear_after_s=0.5)
    for rule in (
        AlarmRule("nobody", "inside", zone="hall", tags=("group:none",)),
        AlarmRule("inside", "inside", zone="hall", tags=WALKERS),
        AlarmRule("outside", "outside", zone="hall", tags=WALKERS),
        AlarmRule("silent", "silent", tags=SILENT, after_s=SILENCE_S),
        AlarmRule("near", "near", limit=2.0, hysteresis=0.3, tags=FIRSTS),
    )
]


def shuttle(rng, low_m, high_m, level_m):
    """Places by time of a way to and fro between two places, at each for a while, and when it crosses a level."""
    times_s, places_m, crossings_s = [], [], [0.0]
    at_s, here_m, there_m = 0.0, low_m, high_m
    while at_s < SECONDS:
        leave_s = at_s + rng.uniform(1.5, 6.0)
        arrive_s = leave_s + (high_m - low_m) / rng.uniform(0.8, 2.0)
        times_s += [at_s, leave_s]
        places_m += [here_m, here_m]
        crossings_s.append(leave_s + (arrive_s - leave_s) * (level_m - here_m) / (there_m - here_m))
        at_s, here_m, there_m = arrive_s, there_m, here_m
    return lambda now_s: float(np.interp(now_s, times_s, places_m)), list(pairwise(crossings_s))


def silences(rng, times_s):
    """The times without those of silences, some too short to count."""
    until_s, next_s = -1.0, rng.uniform(2.0, 8.0)
    for at_s in times_s:
        if at_s >= next_s:
            until_s = at_s + rng.choice((rng.uniform(3.0, 8.0), rng.uniform(0.3, 1.6)))
            next_s = until_s + rng.uniform(2.0, 6.0)
        if at_s >= until_s:
            yield at_s


def world(rng):
    """Fixes as (time, tag, place), and by rule and subject the spans in which the condition holds."""
    spans, fixes = {}, []

    def sends(tag, x_m, y_m, times_s=None):
        times_s = times_s or [(k + rng.random() * 0.2) * INTERVAL_S for k in range(int(SECONDS / INTERVAL_S))]
        fixes.extend((at_s, tag, (rng.gauss(x_m(at_s), STD_M), rng.gauss(y_m, STD_M), 1.0)) for at_s in times_s)
        return times_s

    for k in range(COUNT):
        way, crossed = shuttle(rng, -1.5, 1.5, 0.0)
        spans["outside", f"w{k}"], spans["inside", f"w{k}"] = crossed[::2], crossed[1::2]
        sends(f"w{k}", way, 5.0 * k)
        apart, crossed = shuttle(rng, 0.7, 4.5, 2.0)
        spans["near", f"c{k}~c{k}b"] = crossed[::2]
        times_s = sends(f"c{k}", lambda _: 0.0, 1000.0 + 10.0 * k)
        sends(f"c{k}b", apart, 1000.0 + 10.0 * k)
        heard_s = sends(f"s{k}", lambda _: 3.0, 3000.0 + 5.0 * k, list(silences(rng, times_s)))
        silent = [(a + SILENCE_S, b) for a, b in pairwise([*heard_s, math.inf]) if b - a > SILENCE_S]
        spans["silent", f"s{k}"] = silent
    return sorted(fixes), spans


def published(rng, fixes, *, kills):
    """What is published, with its time; servers are killed every ten seconds on the average, and start again."""
    kept, happened, site, starts_s, coming = {}, [], None, 0.0, fixes[::-1]
    for at_s in np.arange(0.0, SECONDS, TICK_S).tolist():
        if site is None and at_s >= starts_s:
            site = Site(*RULES, zones=ZONES, kept=kept.values(), now_s=at_s)
        while coming and coming[-1][0] <= at_s:
            when_s, tag, place = coming.pop()
            if site is not None:
                site.now_s = when_s
                site.send(tag, place)
        if site is None:
            continue
        site.now_s = at_s
        for one in kept.values():
            if rng.random() < 0.02:
                site.engine.acknowledge(one.rule, one.subject, one.id, "Ada", site.unix_s)
        changes, dies = site.tick(), kills and rng.random() < TICK_S / 10.0
        for what, message in changes[: rng.randrange(len(changes) + 1) if dies else None]:
            happened.append((at_s, what, message))
            kept[message.rule, message.subject] = message
            if is_over(message):
                del kept[message.rule, message.subject]
        if dies:
            site, starts_s = None, at_s + rng.uniform(0.1, 6.0)
    return happened


def delays_s(spans, happened):
    """How late alarms were raised, by rule, subject and number of the span."""
    found = defaultdict(list)
    for at_s, what, message in happened:
        if what == "raised":
            key = message.rule, message.subject
            row = bisect_right(spans[key], at_s + 0.3, key=itemgetter(0)) - 1
            found[(*key, row)].append(at_s - spans[key][row][0])
    return found


def test_every_crossing_silence_and_contact_is_raised_once_and_soon():
    rng = random.Random(1)
    fixes, spans = world(rng)
    found = delays_s(spans, published(rng, fixes, kills=False))
    expected = {
        (*key, row) for key, rows in spans.items() for row, (begin_s, _) in enumerate(rows) if begin_s < SECONDS - 1.0
    }
    assert len(expected) > 150
    assert found.keys() >= expected
    assert all(len(times_s) == 1 and -0.3 <= times_s[0] <= 1.0 for times_s in found.values())


@pytest.mark.parametrize("seed", range(2))
def test_servers_killed_at_random_raise_nothing_twice_and_lose_no_acknowledgement(seed):
    rng = random.Random(seed)
    fixes, spans = world(rng)
    happened = published(rng, fixes, kills=True)
    assert max(map(len, delays_s(spans, happened).values())) == 1
    acknowledged = set()
    for _, what, message in happened:
        assert (message.acknowledged_unix_s is not None) == (what == "acknowledged" or message.id in acknowledged)
        acknowledged |= {message.id} if what == "acknowledged" else set()
    assert len(acknowledged) > 30
