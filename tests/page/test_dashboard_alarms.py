"""Alarms of the live site: one of several dashboards publishes them, and pages are sent them and their rules."""

import msgspec
import pytest
from dashboard_builders import SITE, SITE_ID, SQUARE, Times, Wire, drained, fix, of, status
from msgspec.structs import replace

from skyless.core.site import AlarmRule
from skyless.page._alarms import KEPT_WAIT_S, MAX_SENT, NoAlarmError
from skyless.page.live import LiveSite
from skyless.run.mqtt import messages, topics
from skyless.site.alarm_rules import BadAlarmRulesError

RULE = AlarmRule("r", "inside", zone=SQUARE.id, clear_after_s=0.0)
FILE_RULE = AlarmRule("file", "anchor-moved")
STATE = topics.alarm_topic(SITE_ID, "r", "t1")


class Broker:
    """Keeps retained messages, and delivers to all dashboards that are connected."""

    def __init__(self):
        self.times = Times()
        self.kept = {}
        self.happened = []
        self.dashboards = {}
        self.publish(topics.site_topic(SITE_ID), replace(SITE, alarms=(FILE_RULE,)), retain=True)
        self.publish(topics.zones_topic(SITE_ID), messages.ZonesMessage((SQUARE,), SITE.site.name), retain=True)

    def publish(self, topic, message, *, retain=False):
        payload = message if isinstance(message, bytes) else msgspec.json.encode(message)
        if retain:
            self.kept.pop(topic, None)
            if payload:
                self.kept[topic] = payload
        if "/alarm/" in topic and topic.endswith("/state") and payload:
            self.happened.append(msgspec.json.decode(payload, type=messages.AlarmMessage))
        for live, wire in list(self.dashboards.values()):
            if live.connected:
                wire.deliver(topic, payload)

    def start(self, name):
        live = LiveSite(name, "mqtt://b:1", None, lambda: self.times.now_s, lambda: self.times.unix_s)
        wire = Wire()
        live.attach(wire, SITE_ID)
        self.dashboards[name] = live, wire
        self.connect(name)
        return live

    def connect(self, name):
        live, wire = self.dashboards[name]
        live.on_connection(connected=True)
        for topic, payload in list(self.kept.items()):
            wire.deliver(topic, payload)
        online = status("dashboard", name, unix_s=self.times.unix_s)
        self.publish(topics.status_topic(SITE_ID, "dashboard", name), online, retain=True)

    def disconnect(self, name):
        live, _ = self.dashboards[name]
        live.on_connection(connected=False)
        offline = status("dashboard", name, online=False, unix_s=0.0)
        self.publish(topics.status_topic(SITE_ID, "dashboard", name), offline, retain=True)

    def end(self, name):
        """Its process is killed: what it has not published is lost."""
        self.disconnect(name)
        del self.dashboards[name]

    def run(self, seconds, place=None):
        for step in range(round(seconds / 0.05)):
            self.times.move(0.05)
            if place is not None and step % 2 == 0:
                message = fix(unix_s=self.times.unix_s, position_m=(*place, 1.0), serial=step)
                self.publish(topics.fix_topic(SITE_ID, "t1"), message)
            for live, wire in list(self.dashboards.values()):
                live.tick()
                for topic, payload, _, retain in wire.published:
                    if live.connected and "/alarm" in topic:
                        self.publish(topic, payload, retain=retain)
                wire.published.clear()

    def alarm(self, subject="t1"):
        payload = self.kept.get(topics.alarm_topic(SITE_ID, "r", subject))
        return None if payload is None else msgspec.json.decode(payload, type=messages.AlarmMessage)

    @property
    def raised(self):
        return list(dict.fromkeys(one.id for one in self.happened))


IN, OUT = (2.0, 2.0), (8.0, 8.0)


@pytest.fixture
def broker():
    broker = Broker()
    rules = messages.AlarmRulesMessage((RULE,), SITE.site.name)
    broker.publish(topics.alarm_rules_topic(SITE_ID), rules, retain=True)
    return broker


def test_an_alarm_is_published_kept_acknowledged_and_cleared(broker):
    live = broker.start("a")
    broker.run(KEPT_WAIT_S - 0.2, IN)
    assert broker.happened == [], "what the broker has kept may not be here yet"
    broker.run(1.2, IN)
    alarm = broker.alarm()
    assert (alarm.rule, alarm.subject, alarm.place, alarm.ended_unix_s) == ("r", "t1", "Desk", None)
    assert [one["id"] for one in of("alarms", drained(live))[0]["alarms"]] == [alarm.id]
    assert any("alarm r: t1 has been in Desk" in event.text for event in live.log.events)
    with pytest.raises(NoAlarmError):
        live.acknowledge("r", "t1", "another", "Ada")
    live.acknowledge("r", "t1", alarm.id, "Ada")
    broker.run(0.2, IN)
    assert broker.alarm().acknowledged_by == "Ada"
    assert live.alarms.messages[0].acknowledged_by == "Ada"
    broker.run(1.0, OUT)
    assert broker.alarm() is None
    assert broker.happened[-1].ended_unix_s is not None
    assert live.alarms.messages == ()
    assert of("alarms", drained(live))[0] == {"type": "alarms", "alarms": [], "more": 0}


def test_of_two_dashboards_one_raises_and_the_other_goes_on(broker):
    broker.start("a")
    broker.run(1.0, OUT)
    second = broker.start("b")
    broker.run(4.0, IN)
    assert len(broker.raised) == 1
    assert [live.alarms.engine.leading for live, _ in broker.dashboards.values()] == [True, False]
    second.acknowledge("r", "t1", broker.alarm().id, "Ada")  # the one that leads is asked
    broker.run(0.3, IN)
    assert broker.alarm().acknowledged_by == "Ada"
    assert second.alarms.messages[0].acknowledged_by == "Ada"
    broker.end("a")
    broker.run(5.0, IN)
    assert second.alarms.engine.leading
    assert len(broker.raised) == 1
    broker.run(1.0, OUT)
    assert broker.alarm() is None
    broker.run(1.0, IN)
    assert len(broker.raised) == 2


def restart(broker):
    broker.end("a")
    broker.run(3.0, IN)
    broker.start("a")


def lose_what_was_kept(broker):
    broker.disconnect("a")
    del broker.kept[STATE]
    broker.run(2.0)
    broker.connect("a")


def let_another_lead(broker):
    """One whose clock is behind leads for a while, and does nothing."""
    (live, _), (alarm,) = broker.dashboards["a"], broker.dashboards["a"][0].alarms.messages
    behind = topics.status_topic(SITE_ID, "dashboard", "z")
    broker.publish(behind, status("dashboard", "z", unix_s=1.0), retain=True)
    broker.run(2.0, IN)
    assert (live.alarms.engine.leading, live.alarms.messages) == (False, (alarm,))
    broker.publish(behind, status("dashboard", "z", online=False, unix_s=1.0), retain=True)


@pytest.mark.parametrize("interrupt", [restart, lose_what_was_kept, let_another_lead])
@pytest.mark.parametrize("acknowledged", [True, False])
def test_an_alarm_goes_on_after_what_interrupts_its_dashboard(broker, interrupt, acknowledged):
    first = broker.start("a")
    broker.run(4.0, IN)
    alarm = broker.alarm()
    if acknowledged:
        first.acknowledge("r", "t1", alarm.id, "Ada")
        broker.run(0.2, IN)
    interrupt(broker)
    broker.run(15.0, IN)
    live, _ = broker.dashboards["a"]
    assert live.alarms.engine.leading
    assert broker.raised == [alarm.id]
    assert broker.alarm().acknowledged_by == ("Ada" if acknowledged else "")
    assert live.alarms.messages == (broker.alarm(),)


def test_what_another_has_done_meanwhile_is_not_undone_after_a_reconnect(broker):
    broker.start("a")
    broker.run(1.0, OUT)
    second = broker.start("b")
    broker.run(4.0, IN)
    broker.disconnect("a")
    assert STATE in broker.dashboards["a"][1].forgotten
    broker.run(3.0, IN)
    second.acknowledge("r", "t1", broker.alarm().id, "Ada")
    broker.run(2.0, OUT)
    assert broker.alarm() is None
    broker.connect("a")
    broker.run(5.0, OUT)
    broker.end("b")
    broker.run(5.0, OUT)
    assert broker.alarm() is None
    assert broker.dashboards["a"][0].alarms.messages == ()


@pytest.mark.parametrize("place", [IN, OUT])
def test_an_acknowledgement_that_the_first_did_not_publish_is_published_by_the_next(broker, place):
    broker.start("a")
    broker.run(1.0, OUT)
    broker.start("b")
    broker.run(4.0, IN)
    broker.run(1.0, place)
    alarm = broker.alarm()
    broker.dashboards["a"][0].connected = False  # it hears nothing any more
    broker.publish(
        topics.acknowledge_topic(SITE_ID, "r", "t1"), messages.AcknowledgeMessage(alarm.id, "Ada", broker.times.unix_s)
    )
    broker.end("a")
    broker.run(3.0, place)
    assert (broker.happened[-1].id, broker.happened[-1].acknowledged_by) == (alarm.id, "Ada")
    assert (broker.alarm() is None) == (place == OUT)
    assert broker.raised == [alarm.id]


def test_rules_of_the_page_are_stored_checked_and_sent(broker):
    live = broker.start("a")
    broker.run(0.2)
    assert [rule["id"] for rule in of("alarm_rules", drained(live))[0]["rules"]] == ["r"]
    assert [rule["id"] for rule in of("alarm_rules", drained(live))[0]["file_rules"]] == ["file"]
    new = AlarmRule("quiet", "silent", after_s=5.0)
    live.alarms.store_rules([RULE, new], SITE.site.name)
    broker.run(0.2)
    kept = msgspec.json.decode(broker.kept[topics.alarm_rules_topic(SITE_ID)], type=messages.AlarmRulesMessage)
    assert kept == messages.AlarmRulesMessage((RULE, new), SITE.site.name)
    assert live.alarms.engine.rules == (FILE_RULE, RULE, new)
    for rules, site, words in (
        ([AlarmRule("file", "anchor-moved")], "", "no other rule"),
        ([AlarmRule("x", "silent")], "", "after_s"),
        ([], "elsewhere", "which is shown now"),
    ):
        with pytest.raises((BadAlarmRulesError, messages.WrongMessageError), match=words):
            live.alarms.store_rules(rules, site)
    broker.publish(topics.alarm_rules_topic(SITE_ID), messages.AlarmRulesMessage((new,), "another site"), retain=True)
    broker.run(0.2)
    assert live.alarms.rules == ()


def test_pages_are_sent_the_newest_and_those_that_nobody_has_seen_first(live, wire):
    for k in range(MAX_SENT + 7):
        seen = 5.0 if k % 2 else None
        one = messages.AlarmMessage(
            f"r/t{k}/{k}", "r", "r", "inside", "info", f"t{k}", k, k, "", acknowledged_unix_s=seen
        )
        wire.deliver(topics.alarm_topic(SITE_ID, "r", f"t{k}"), one)
    message = of("alarms", drained(live))[0]
    assert (len(message["alarms"]), message["more"]) == (MAX_SENT, 7)
    unseen = [one for one in message["alarms"] if one["acknowledged_unix_s"] is None]
    assert unseen == message["alarms"][: len(unseen)]
    assert len(unseen) == (MAX_SENT + 8) // 2
    assert [one["unix_s"] for one in unseen] == sorted((one["unix_s"] for one in unseen), reverse=True)


def test_alarms_name_assets(broker):
    live = broker.start("a")
    live.assets.store((messages.Asset("t1", name="Ada"),))
    broker.run(4.0, IN)
    assert broker.alarm().sentence.startswith("Ada (t1) has been in Desk for ")
