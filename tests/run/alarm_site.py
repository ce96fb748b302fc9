"""An engine of alarms with its monitor of zones and its table, tags that send fixes, and a clock."""

import math
import time

import msgspec

from skyless.core.alert import Alert
from skyless.run.alarms import AlarmEngine
from skyless.run.mqtt.messages import AlarmMessage, StatusMessage, Zone
from skyless.run.site_table import THRESHOLDS, SiteTable
from skyless.run.zones import ZoneMonitor
from support.site_messages import a_fix, diagonal, tag_health

HALL = Zone("hall", "Hall", ((0.0, 0.0), (16.0, 0.0), (16.0, 16.0), (0.0, 16.0)))
IN, OUT = (5.0, 5.0, 1.0), (25.0, 5.0, 1.0)
EPOCH_S = 1_795_053_600.0
"""A Thursday, 02:00 UTC."""
STEP_S = 0.25
"""Longer than ``EVALUATION_S``, so that conditions are evaluated in each step, and exact in binary."""
BEGIN_S = 64.0
"""Clocks that go only forward are not Unix time, and do not begin at 0."""


class Site:
    """An engine with its monitor; time goes on in steps while tags send fixes from where they are."""

    def __init__(self, *rules, kept=(), assets=(), zones=(HALL,), longest_s=THRESHOLDS.longest_s, now_s=BEGIN_S):
        self.now_s, self.blind = now_s, False
        self.places, self.levels_m, self.happened = {}, {}, []
        self.monitor, self.table = ZoneMonitor(), SiteTable(now_s)
        self.table.longest_s = longest_s
        self.engine = AlarmEngine(self.monitor, self.table, time.gmtime)
        self.engine.set_assets({asset.tag: asset for asset in assets})
        self.set_zones(zones)
        self.engine.set_rules(rules)
        self.resume(kept)

    @property
    def unix_s(self):
        return EPOCH_S - BEGIN_S + self.now_s

    @property
    def last(self):
        return self.happened[-1][1]

    def resume(self, kept):
        """As the broker keeps them: in JSON."""
        kept = msgspec.json.decode(msgspec.json.encode(list(kept)), type=list[AlarmMessage])
        self.engine.resume(kept, self.now_s, self.unix_s)

    def set_zones(self, zones):
        self.engine.on_zone_events(self.monitor.set_zones(zones, self.unix_s), self.now_s)
        self.engine.set_zones(zones, self.now_s)

    def send(self, tag, place):
        fields = {"unix_s": self.unix_s, "position_m": place, "covariance_m2": diagonal(1e-4, 1e-4, 1e-4)}
        level_m = self.levels_m.get(tag)
        fields |= {"alert": Alert.NOT_EXCLUDED.value} if level_m == math.inf else {"hpl_m": level_m}
        fix = a_fix(tag, **fields)
        self.table.add_fix(fix, self.now_s)
        self.engine.on_fix(tag)
        self.engine.on_zone_events(self.monitor.update(fix), self.now_s)

    def tick(self):
        for tag in self.table.tick(self.now_s):
            self.engine.on_zone_events(self.monitor.remove_tag(tag, self.unix_s), self.now_s)
        changes = self.engine.tick(self.now_s, self.unix_s, blind=self.blind)
        self.happened += changes
        return changes

    def run(self, seconds, step_s=STEP_S):
        """What happens: the time since the beginning of this run, what, rule and subject; without updates."""
        begin_s, happened = self.now_s, []
        while self.now_s < begin_s + seconds:
            self.now_s += step_s
            for tag, place in self.places.items():
                self.send(tag, place)
            happened += [(self.now_s - begin_s, what, one.rule, one.subject) for what, one in self.tick()]
        return [one for one in happened if one[1] != "updated"]

    def hear_health(self, tag, battery_share):
        health = tag_health(tag, battery_share=battery_share)
        self.table.add_health("tag", tag, health, self.now_s)
        self.engine.on_health(health)

    def end(self, tag):
        """The tag's program says that it ends."""
        self.places.pop(tag, None)
        self.table.add_status(StatusMessage(online=False, kind="tag", name=tag), self.now_s)
        self.engine.on_zone_events(self.monitor.remove_tag(tag, self.unix_s), self.now_s)

    def measure(self, kind, value):
        """Bring about a value of a kind of rule with a limit."""
        match kind:
            case "near":
                self.places |= {"t": IN, "u": (5.0 + value, 5.0, 1.0)}
            case "crowded":
                self.places |= {f"t{k}": IN if k < value else OUT for k in range(4)}
            case "protection-level":
                self.places["t"], self.levels_m["t"] = IN, value
            case "battery":
                self.hear_health("t", value)
