"""Alarms of a simulated site: tags walk in and out of a zone, fall silent and meet, with noisy fixes.

What must be raised follows from their true ways alone. The page's server may be killed at random moments. The time is
simulated, so that broker and network, which add some milliseconds, do not count.
"""

import math
import random
from bisect import bisect_right
from collections import Counter, defaultdict
from itertools import pairwise

from skyless.core.site import AlarmRule
from skyless.run.alarms import AlarmEngine, is_over
from skyless.run.mqtt.messages import FixMessage, Zone
from skyless.run.site_table import SiteTable
from skyless.run.zones import ZoneMonitor

UNIX_S = 1_795_000_000.0
TICK_S = 0.05
HZ = 10.0
STD_M = 0.03
LIMIT_M = 2.0
SILENCE_S = 2.0
COUNT = 24
"""Tags that walk, tags that fall silent, and pairs that meet."""
WALKERS, SILENT, FIRSTS = (tuple(f"{letter}{k}" for k in range(COUNT)) for letter in "wsc")
RULES = (
    AlarmRule("nobody", "inside", zone="hall", tags=("group:none",)),
    AlarmRule("inside", "inside", zone="hall", tags=WALKERS, clear_after_s=0.5),
    AlarmRule("outside", "outside", zone="hall", tags=WALKERS, clear_after_s=0.5),
    AlarmRule("silent", "silent", tags=SILENT, after_s=SILENCE_S, clear_after_s=0.5),
    AlarmRule("near", "near", limit=LIMIT_M, hysteresis=0.3, tags=FIRSTS, clear_after_s=0.5),
)
ZONES = (Zone("hall", "Hall", ((0.0, -10.0), (20.0, -10.0), (20.0, 900.0), (0.0, 900.0))),)


def fix_of(tag: str, unix_s: float, x: float, y: float, serial: int = 1) -> FixMessage:
    variance = STD_M**2
    return FixMessage(
        tag, serial, unix_s, unix_s, (x, y, 1.0), (variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance),
        None, None, STD_M, 1.0, 1.0, 1.0, 1.0, (1, 2, 3, 4), 1.0, 1, 0.01, "joint", False, 0.001,
    )  # fmt: skip


class Way:
    """A tag's true place along x by time: straight lines between knots."""

    def __init__(self, knots: list[tuple[float, float]]) -> None:
        self.knots = knots
        self._at = 0

    def x_m(self, at_s: float) -> float:
        while self._at + 2 < len(self.knots) and self.knots[self._at + 1][0] <= at_s:
            self._at += 1
        (t0, x0), (t1, x1) = self.knots[self._at : self._at + 2]
        return x0 + (x1 - x0) * (at_s - t0) / (t1 - t0)

    def below(self, level_m: float) -> list[tuple[float, float]]:
        """The spans of time in which it is below a level."""
        crossings = [
            (t0 + (level_m - x0) / (x1 - x0) * (t1 - t0), x1 < x0)
            for (t0, x0), (t1, x1) in pairwise(self.knots)
            if (x0 - level_m) * (x1 - level_m) < 0.0
        ]
        starts = [at_s for at_s, down in crossings if down]
        if self.knots[0][1] < level_m:
            starts.insert(0, self.knots[0][0])
        ends = [at_s for at_s, down in crossings if not down]
        return [(start, min([at_s for at_s in ends if at_s > start], default=math.inf)) for start in starts]


def shuttle(rng: random.Random, seconds: float, low_m: float, high_m: float) -> Way:
    """To and fro between two places, at each for a while."""
    knots, at_s, low = [], 0.0, True
    while at_s < seconds + 30.0:
        stay_s, go_s = rng.uniform(1.5, 6.0), (high_m - low_m) / rng.uniform(0.8, 2.0)
        place = low_m if low else high_m
        knots += [(at_s, place), (at_s + stay_s, place)]
        at_s, low = at_s + stay_s + go_s, not low
    return Way(knots)


class World:
    """What happens, and the spans in which each condition holds by the true ways."""

    def __init__(self, seconds: float, seed: int) -> None:
        rng = random.Random(seed)
        self.seconds = seconds
        self.spans: dict[tuple[str, str], list[tuple[float, float]]] = {}
        fixes = []
        for k in range(COUNT):
            way = shuttle(rng, seconds, -1.5, 1.5)
            outside = way.below(0.0)
            edges = [end for _, end in outside]
            inside = [
                (end, min([a for a, _ in outside if a > end], default=math.inf)) for end in edges if end < math.inf
            ]
            self.spans["outside", f"w{k}"], self.spans["inside", f"w{k}"] = outside, inside
            fixes += [(at_s, f"w{k}", way.x_m(at_s), 5.0 * k) for at_s in instants(rng, seconds)]
            apart = shuttle(rng, seconds, 0.7, 4.5)
            self.spans["near", f"c{k}~c{k}b"] = apart.below(LIMIT_M)
            y = 1000.0 + 10.0 * k
            fixes += [(at_s, f"c{k}", 0.0, y) for at_s in instants(rng, seconds)]
            fixes += [(at_s, f"c{k}b", apart.x_m(at_s), y) for at_s in instants(rng, seconds)]
            heard = list(silences(rng, instants(rng, seconds)))
            self.spans["silent", f"s{k}"] = [
                (a + SILENCE_S, b)
                for a, b in pairwise([*heard, math.inf])
                if b - a > SILENCE_S and a + SILENCE_S < seconds
            ]
            fixes += [(at_s, f"s{k}", 3.0, 3000.0 + 5.0 * k) for at_s in heard]
        noisy = [(at_s, tag, x + rng.gauss(0.0, STD_M), y + rng.gauss(0.0, STD_M)) for at_s, tag, x, y in fixes]
        self.fixes = sorted(noisy)


def instants(rng: random.Random, seconds: float) -> list[float]:
    phase_s = rng.random() / HZ
    return [phase_s + k / HZ + rng.uniform(0.0, 0.02) for k in range(int(seconds * HZ))]


def silences(rng: random.Random, times_s: list[float]):
    """The instants without those of silences, some too short to count."""
    until_s, next_s = -1.0, rng.uniform(2.0, 8.0)
    for at_s in times_s:
        if at_s >= next_s:
            until_s = at_s + rng.choice((rng.uniform(3.0, 8.0), rng.uniform(0.3, 1.6)))
            next_s = until_s + rng.uniform(2.0, 6.0)
        if at_s >= until_s:
            yield at_s


class Server:
    """A page server: its engine, and what it publishes to a broker that keeps messages."""

    def __init__(self, kept: dict, at_s: float) -> None:
        self.monitor = ZoneMonitor()
        self.table = SiteTable(at_s)
        self.engine = AlarmEngine(self.monitor, self.table)
        unix_s = UNIX_S + at_s
        self.engine.on_zone_events(self.monitor.set_zones(ZONES, unix_s), at_s)
        self.engine.set_zones(ZONES, at_s)
        self.engine.set_rules(RULES)
        self.engine.resume(kept.values(), at_s, unix_s)
        self._expired_s = at_s

    def on_fix(self, fix: FixMessage, at_s: float) -> None:
        self.table.add_fix(fix, at_s)
        self.engine.on_fix(fix.tag)
        self.engine.on_zone_events(self.monitor.update(fix), at_s)

    def tick(self, at_s: float) -> list:
        if at_s - self._expired_s >= 1.0:
            self._expired_s = at_s
            for tag in self.table.tick(at_s):
                self.engine.on_zone_events(self.monitor.remove_tag(tag, UNIX_S + at_s), at_s)
        return self.engine.tick(at_s, UNIX_S + at_s)


def run(world: World, seed: int, kill_every_s: float = math.inf):
    """Everything that was published with its time, the alarms acknowledged, and when no server ran."""
    rng = random.Random(seed)
    kept: dict = {}
    published: list = []
    acknowledged: dict[str, float] = {}
    down: list[tuple[float, float]] = []
    server: Server | None = Server(kept, 0.0)
    next_kill_s = rng.expovariate(1.0 / kill_every_s) if kill_every_s < math.inf else math.inf
    number = 0
    for step in range(int(world.seconds / TICK_S)):
        at_s = step * TICK_S
        while number < len(world.fixes) and world.fixes[number][0] <= at_s:
            when_s, tag, x, y = world.fixes[number]
            number += 1
            if server is not None:
                server.on_fix(fix_of(tag, UNIX_S + when_s, x, y), when_s)
        if server is None:
            if at_s >= down[-1][1]:
                server = Server(kept, at_s)
            continue
        for one in [one for one in kept.values() if one.acknowledged_unix_s is None]:
            if rng.random() < 0.02:
                server.engine.acknowledge(one.rule, one.subject, one.id, "Ada", UNIX_S + at_s)
        changes = server.tick(at_s)
        dies = at_s >= next_kill_s
        for what, message in changes[: rng.randrange(len(changes) + 1) if dies else None]:
            key = message.rule, message.subject
            published.append((at_s, what, message))
            if is_over(message):
                kept.pop(key, None)
            else:
                kept[key] = message
            if what == "acknowledged":
                acknowledged[message.id] = at_s
        if dies:
            server = None
            down.append((at_s, at_s + rng.uniform(0.1, 6.0)))
            next_kill_s = at_s + 8.0 + rng.expovariate(1.0 / kill_every_s)
    return published, acknowledged, down, kept


def judge(world: World, published: list, slack_s: float = 1.0) -> tuple[Counter, dict[str, list[float]]]:
    """Counts by outcome, and how late the alarms were by rule."""
    raised = defaultdict(list)
    for at_s, what, message in published:
        if what == "raised":
            raised[message.rule, message.subject].append(at_s)
    counts: Counter = Counter()
    late_s = defaultdict(list)
    for key, spans in world.spans.items():
        mine = defaultdict(list)
        begins_s = [begin_s - 0.3 for begin_s, _ in spans]
        for at_s in raised.pop(key, []):
            row = bisect_right(begins_s, at_s) - 1
            if row < 0 or at_s > spans[row][1] + slack_s:
                counts["without a cause"] += 1
            else:
                mine[row].append(at_s)
        for row, (begin_s, _) in enumerate(spans):
            if begin_s <= world.seconds - slack_s:
                counts["expected"] += 1
                counts["missed"] += not mine[row]
                counts["twice"] += max(0, len(mine[row]) - 1)
                late_s[key[0]] += [max(0.0, at_s - begin_s) for at_s in mine[row][:1]]
    counts["without a cause"] += sum(map(len, raised.values()))
    return counts, late_s


def percentile(values: list[float], share: float) -> float:
    return sorted(values)[min(len(values) - 1, int(share * len(values)))] if values else math.nan


def lost(published: list, acknowledged: dict, kept: dict) -> list:
    """Alarms that are unacknowledged after they were acknowledged."""
    wrong = [one.id for one in kept.values() if one.id in acknowledged and one.acknowledged_unix_s is None]
    return wrong + [
        m.id for at_s, _, m in published if at_s > acknowledged.get(m.id, math.inf) and m.acknowledged_unix_s is None
    ]
