"""One feed, all views: of tags that sleep, at every moment of an hour, each view says the same.

A second page gets the fixes in batches alone, and lists them as the first one does.
"""

import random
from itertools import pairwise
from operator import itemgetter
from types import SimpleNamespace

import msgspec
import pytest
from dashboard_builders import SITE, SITE_ID, Times, Wire, fix, status
from test_dashboard_condition import anchor_health

from skyless.bridges.foxglove import FoxgloveTarget
from skyless.bridges.home_assistant import Announcer
from skyless.bridges.prometheus import SiteMetrics
from skyless.bridges.target import Hub, Route, Target, bridged_site
from skyless.cli.nodes.site_view import SiteView
from skyless.page.api import questions
from skyless.page.live import LiveSite
from skyless.run.fix_batch import FIELDS, fix_of, records_of
from skyless.run.gather.node import SiteCondition
from skyless.run.gather.streams import TagName
from skyless.run.gather.subjects import NatsAddress
from skyless.run.hub import HubSites
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import TagZones, Zone, ZonesMessage
from skyless.run.mqtt.topics import tag_zones_topic

pytestmark = pytest.mark.site

ZONES = tuple(
    Zone(name, name, ((x, 0.0), (x + 10.0, 0.0), (x + 10.0, 10.0), (x, 10.0))) for name, x in (("a", 0.0), ("b", 20.0))
)
HOUR_S = 3600
PLACE = itemgetter(1, 2, 3, 15)
"""Position and time in a row of the page."""
TAGS = {"often": 1, "rare": 10, "rarer": 60}
"""Seconds between fixes."""


class Both(Target):
    """Home Assistant and Prometheus as targets of one hub, without a broker and without a server."""

    def __init__(self, site):
        super().__init__("both:")
        self.kept = {}
        link = SimpleNamespace(subscribe=lambda *_: None, publish=self.keep, forget=lambda _: None)
        self.announcer = Announcer(link, site, "bridge", "homeassistant", 0.25)

    def keep(self, topic, message, **_):
        self.kept[topic] = message

    def use(self, table):
        self.metrics = SiteMetrics(table)

    def on_fix(self, fix):
        self.announcer.on_fix(fix)
        self.metrics.on_fix(fix)

    def on_gone(self, tag, unix_s):
        self.announcer.on_gone(tag, unix_s)

    def zones(self, tag):
        found = self.kept.get(tag_zones_topic(SITE_ID, tag), TagZones(tag, 0.0, usable=False))
        return (found.usable, sorted(found.zones))


class Shown(FoxgloveTarget):
    """What a client that has subscribed to everything gets last, by topic."""

    def __init__(self):
        super().__init__("foxglove:", "127.0.0.1", 0)
        self.newest = {}

    def _give(self, topic, schema, unix_s, encode):
        self.newest[topic] = unix_s, msgspec.json.decode(encode())


class Views:
    """The page, its HTTP interface, ``skyless watch``, bridges, a gather and its hub, all of the same messages."""

    def __init__(self):
        self.times, self.wires = Times(), (Wire(), Wire(), Wire())
        clocks = (lambda: self.times.now_s, lambda: self.times.unix_s)
        self.page, self.batched = (LiveSite("here", "mqtt://b:1", None, *clocks) for _ in range(2))
        for page, wire in ((self.page, self.wires[0]), (self.batched, self.wires[2])):
            page.attach(wire, SITE_ID)
            page.on_connection(connected=True)
        self.gathered, self.judged = SiteCondition(self.times.now_s), ("bad", [])
        self.watch = SiteView(self.wires[1], SITE_ID, *clocks)
        self.wires[1].on_state[0](True)
        site = bridged_site(SITE.whole_site, ZONES, simulated=True)
        self.both, self.foxglove = Both(site), Shown()
        self.sites = HubSites(NatsAddress("hub", 1, ""), self.times.now_s)
        self.hub = Hub([Route(target, None, 1000.0) for target in (self.both, self.foxglove)], print)
        self.hub.on_site(site)
        self.say(topics.site_topic(SITE_ID), SITE)
        self.wires[2].deliver(topics.site_topic(SITE_ID), SITE)
        for wire in (self.wires[0], self.wires[2]):
            wire.deliver(topics.zones_topic(SITE_ID), ZonesMessage(ZONES, SITE.site.name))

    def say(self, topic, message):
        for wire in self.wires[:2]:
            wire.deliver(topic, message)
        self.gathered.on_message(topic, msgspec.json.encode(message), self.times.now_s)

    def fix(self, tag, place_m):
        one = fix(tag, self.times.unix_s, (*place_m, 1.0))
        self.say(topics.fix_topic(SITE_ID, tag), one)
        self.hub.on_fix(one, self.times.now_s)
        records = records_of([(1, one)], simulated=False)
        self.gathered.on_batch(records, {1: TagName(tag, "here", 0.0)}, self.times.now_s)
        (record,) = FIELDS.iter_unpack(records.tobytes())
        self.batched.add_fix(fix_of(tag, record), self.times.now_s, batched=True)
        self.batched.table.hear([tag], self.times.now_s)

    def end(self, tag):
        gone = status("tag", tag, online=False)
        for say in (self.say, self.wires[2].deliver):
            say(topics.status_topic(SITE_ID, "tag", tag), gone)
        self.hub.on_status(gone, self.times.now_s, self.times.unix_s)

    def tick(self, second):
        for anchor in SITE.site.anchors if second % 3 == 0 else ():
            health = anchor_health(anchor.id, self.times.unix_s)
            for say in (self.say, self.wires[2].deliver):
                say(topics.health_topic(SITE_ID, "anchor", str(anchor.id)), health)
        self.page.tick()
        self.batched.tick()
        self.watch.evaluate()
        self.hub.on_tick(self.times.now_s, self.times.unix_s)
        self.judged = self.gathered.reasons({}, 0, self.times.now_s)
        word, reasons = self.judged
        summary = {"unix_s": self.times.unix_s, "host": "", "version": "", "site": "here", "simulated": True}
        summary |= {"condition": word, "reasons": reasons, "tags_heard": self.gathered.tags_heard(self.times.now_s)}
        summary |= {"names": 0, "online": {}, "fixes": 0, "batches": 0, "waiting": 0, "drops": {}, "cuts": 0}
        self.sites.add_summary(1, msgspec.json.encode(summary), self.times.now_s, self.times.unix_s)

    def compare(self):
        """Check that all views agree on each tag; the words for what they say."""
        answers = {tag.tag: tag for tag in questions.tags(self.page).tags}
        rows = {row.tag: row for row in self.watch.picture().tags}
        text = self.both.metrics.figures(self.times.now_s)
        shown = {row[0]: row for row in self.page.state.rows_since(0)}
        in_batches = {row[0]: row for row in self.batched.state.rows_since(0)}
        found = {}
        for name, answer in answers.items():
            tag = self.page.table.get("tag", name)
            is_there = self.page.table.is_there(tag, self.times.now_s)
            is_fresh = answer.presence == "fresh"
            assert self.both.zones(name) == (is_there, sorted(answer.zones))
            assert f'skyless_tag_present{{tag="{name}"}} {float(is_there)}' in text
            assert (f'skyless_tag_error_std_metres{{tag="{name}"}}' in text) == is_fresh
            assert (rows[name].state == "fix") == is_fresh == (answer.fix is not None)
            age_s, (fresh_s, sleep_s, gone_s) = self.times.now_s - tag.fix_s, shown[name][-3:]
            assert (is_fresh, sleep_s) == (age_s < fresh_s, 0.0)
            assert is_there == (age_s < gone_s)
            (unix_s, newest), fix = self.foxglove.newest[f"/tag/{name}/fix"], tag.fix
            assert (newest["position_m"], newest["unix_s"], unix_s) == ([*fix.position_m], fix.unix_s, fix.unix_s)
            assert self.foxglove.newest[f"/tag/{name}/pose"][1]["pose"]["position"]["x"] == shown[name][1]
            if tag.online is not False:  # batches do not tell that a program has ended
                assert self.batched.presence(name) == answer.presence
                assert PLACE(in_batches[name]) == pytest.approx(PLACE(shown[name]))
                assert [zone.id for zone in self.batched.monitor.zones_with(name)] == list(answer.zones)
            found[name] = answer.presence, answer.zones
        assert self.watch.condition == self.page.condition
        judged = self.batched.condition
        assert self.judged[1] == [reason.text for reason in judged.reasons]
        assert self.judged[0] == {"warning": "degraded"}.get(judged.level, judged.level)
        (site,) = self.sites.sites(self.times.now_s)
        assert (site.condition, site.reason) == (self.judged[0], "".join(self.judged[1][:1]))
        assert site.tags_heard == sum(presence != "gone" for presence, _ in found.values())
        assert self.page.condition.tags_with_fix == sum(presence == "fresh" for presence, _ in found.values())
        return found


def test_all_views_say_the_same_at_every_moment_of_an_hour_with_sleeping_tags():
    views, draw = Views(), random.Random(4)
    places = dict.fromkeys(TAGS, (5.0, 5.0))
    rooms = {name: [] for name in TAGS}
    for second in range(HOUR_S):
        views.times.move(1.0)
        if second % 600 == 300:
            places = {name: (draw.choice((5.0, 15.0, 25.0)), 5.0) for name in TAGS}
        for name, interval_s in TAGS.items():
            is_away = (name == "often" and 1000 <= second < 1100) or (name == "rare" and second > 3345)
            if second % interval_s == 0 and not is_away:
                views.fix(name, places[name])
        if second == 3345:
            views.end("rare")
        views.tick(second)
        if second % 5 == 4:
            found = views.compare()
            for name in TAGS:
                if name in found and rooms[name][-1:] != [found[name][1]]:
                    rooms[name].append(found[name][1])
        if second == 1050:
            assert found["often"][0] == "gone"
    assert found["rare"][0] == "gone"
    crossings = [set(one) ^ set(other) for places in rooms.values() for one, other in pairwise([(), *places])]
    events = [payload for topic, payload, *_ in views.wires[0].published if topic.endswith("/event")]
    assert len(events) == sum(map(len, crossings)), "as often as they went elsewhere, and no more"
