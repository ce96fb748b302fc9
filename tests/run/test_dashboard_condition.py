"""The condition of the site: faults are found in time with their cause, are gone soon after; green has evidence."""

import pytest
from dashboard_builders import SITE, fix, status
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.site import UnplacedAnchor
from skyless.run.condition.evidence import Evidence
from skyless.run.condition.monitor import EVALUATION_S, HOLD_S, START_S, ConditionMonitor, alert_reasons
from skyless.run.mqtt.messages import EtherHealth, WatchFinding, WatchMessage
from skyless.run.site_table import THRESHOLDS, SiteTable
from support import site_messages
from support.site_messages import tag_health

IDS = [anchor.id for anchor in SITE.site.anchors]
HOST = "here"


def anchor_health(anchor, unix_s, master=1, term=0, **more):
    role = "master" if anchor == master else "anchor"
    return site_messages.anchor_health(anchor, unix_s=unix_s, role=role, master=master, term=term, **more)


class Hall:
    """A site whose programs report regularly, apart from what a test changes."""

    def __init__(self, tags=("t1", "t2"), connected=True):
        self.now_s = 100.0
        self.table = SiteTable(self.now_s, HOST, connected=connected)
        self.evidence = Evidence(self.table)
        self.monitor = ConditionMonitor(self.evidence)
        self.table.set_site(SITE.site, self.now_s)
        self.silent, self.delay_s, self.latency_s, self.alert = set(), 0.0, 1e-3, None
        self.anchors, self.tags, self.air, self.lag_s, self.watch = {}, {}, {}, 0.0, (None, None)
        self.used_share = None
        self.names, self.receptions, self.clock_error_s, self.host = tags, 0, 0.0, HOST
        self.online, self.used = False, (1, 2, 3, 4)
        """Whether the programs run, and the anchors that fixes use."""

    def start(self):
        for anchor in IDS:
            self.evidence.add_status(status("anchor", str(anchor)), self.now_s)
        for name in self.names:
            self.evidence.add_status(replace(status("tag", name), host=self.host), self.now_s)
        self.online = True
        return self

    def run(self, seconds, rate_hz=10.0):
        """Pass time; the last condition."""
        condition = None
        for step in range(round(seconds * rate_hz)):
            self.now_s += 1 / rate_hz
            if self.online:
                self._report(step % round(rate_hz) == 0)
            if step % round(EVALUATION_S * rate_hz) == 0:
                condition = self.monitor.evaluate(self.now_s, self.lag_s, *self.watch, self.used_share)
        return condition

    def _report(self, second):
        unix_s = 1e9 + self.now_s
        self.receptions += 40
        for name in self.names:
            if name in self.silent:
                continue
            made = unix_s - self.delay_s - self.clock_error_s - self.latency_s
            self.evidence.add_fix(
                fix(name, made, latency_s=self.latency_s, alert=self.alert, anchors=self.used, serial=self.receptions),
                self.now_s,
                unix_s,
            )
        if second:
            for anchor in IDS:
                if anchor not in self.silent:
                    health = anchor_health(anchor, unix_s, **self.anchors)
                    self.evidence.add_health("anchor", str(anchor), health, self.now_s, unix_s)
            for name in self.names:
                more = {"receptions": self.receptions} | self.tags.get(name, {})
                sent = unix_s - self.delay_s - self.clock_error_s
                self.evidence.add_health("tag", name, tag_health(name, unix_s=sent, **more), self.now_s, unix_s)
            if self.air is not None:
                air = replace(EtherHealth(unix_s, 1.0, 5, 0, {}, {}, 0, 0), **self.air)
                self.evidence.add_health("ether", "air", air, self.now_s, unix_s)


@pytest.fixture
def hall():
    hall = Hall().start()
    assert hall.run(10.0).level == "good"
    return hall


def test_a_site_that_starts_is_not_green_before_a_position_has_come():
    hall = Hall(connected=False)
    assert (hall.run(1.0).level, hall.run(1.0).text) == ("waiting", "waiting for the broker")
    hall.table.set_connected(connected=True, now_s=hall.now_s)
    assert (hall.run(3.0).level, hall.run(1.0).text) == ("waiting", "no tag is online")
    for anchor in IDS:
        hall.evidence.add_status(status("anchor", str(anchor), online=False), hall.now_s)  # kept of yesterday
    assert hall.run(THRESHOLDS.grace_s).level == "waiting"
    hall.start()
    condition = hall.run(1.0)
    assert (condition.level, condition.text, condition.reasons) == ("good", "", ())
    assert condition.latency_p50_s == pytest.approx(1e-3, abs=1e-6)


def test_anchors_that_never_come_online_are_reported_after_a_while():
    hall = Hall()
    assert hall.run(START_S + 1.0).text == f"all {len(IDS)} anchors are offline"


def test_a_site_that_is_not_set_up_has_no_fault(hall):
    bare = tuple(UnplacedAnchor(anchor.id) for anchor in SITE.site.anchors)
    hall.table.set_site(replace(SITE.site, anchors=(), unplaced=bare), hall.now_s)
    hall.silent = {"t1", "t2", *IDS}
    found = hall.run(10.0)
    assert (found.level, found.text) == ("waiting", "not set up yet: tab Set up")


def test_without_a_broker_nothing_else_is_judged(hall):
    hall.table.set_connected(connected=False, now_s=hall.now_s)
    condition = hall.run(0.5)
    assert (condition.level, [reason.kind for reason in condition.reasons]) == ("bad", ["broker"])
    hall.table.set_connected(connected=True, now_s=hall.now_s)
    assert hall.run(1.0).level == "good"


def test_subscriptions_that_the_broker_refuses_are_a_fault(hall):
    condition = hall.monitor.evaluate(hall.now_s, refused={"skyless/v1/7/zones"})
    assert (condition.level, condition.reasons[0].kind) == ("bad", "refused")
    assert "skyless/v1/7/zones" in condition.text and "no room" in condition.reasons[0].advice


def test_processors_in_full_use_are_a_warning_but_where_the_air_is_emulated():
    hall = Hall()
    hall.air = None
    hall.start().used_share = 0.98
    (busy,) = hall.run(10.0).reasons
    assert (busy.kind, busy.text) == ("busy", "this computer is fully busy: 98 % of its processors are in use")
    hall.air = {}
    assert hall.run(10.0).level == "good"


REFLECTED = {"multipath_std_m": 0.08, "multipath_distance_m": 0.12}


@pytest.mark.parametrize(
    ("change", "level", "kind", "words"),
    [
        ({"latency_s": 2.3}, "bad", "late", "positions are 2.3 s behind: this computer does not"),
        ({"latency_s": 0.4}, "warning", "late", "positions are 0.4 s behind"),
        ({"delay_s": 2.0}, "bad", "late", "2.0 s behind: the broker or the network delivers late"),
        ({"air": {"missed_share": 0.32}}, "warning", "slow", "the emulated air missed 32 % of the"),
        ({"anchors": {"missed_share": 0.7}}, "bad", "slow", "this computer is too slow: 6 anchors"),
        ({"lag_s": 0.6}, "warning", "slow", "the page's server was delayed by 0.6 s"),
        ({"tags": {"t2": REFLECTED}}, "warning", "multipath", "tag t2 finds that ranges change by 8 cm within 12 cm"),
        ({"alert": "detected-excluded"}, "warning", "alert", "tags t1 and t2: a faulty anchor is"),
        ({"alert": "alert-limit-exceeded"}, "bad", "limit", "above the alert limit"),
        ({"silent": {2}}, "warning", "silent-anchors", "anchor 2 does not report, though on the air"),
        ({"silent": {5, 6}}, "warning", "anchors", "anchors 5 and 6 of 6 are offline"),
        ({"silent": {3, 4, 5, 6}}, "bad", "anchors", "of 6 are offline"),
        ({"anchors": {"synchronised": False}}, "warning", "not-synchronised", "5 and 6 are not sync"),
        ({"anchors": {"chain": 1, "code_fault": "no-chain"}}, "warning", "codes", "no key chain holds"),
        ({"tags": {"t1": {"trust": "open"}}}, "bad", "not-verified", "nothing that tag t1 receives is"),
        ({"silent": {"t1"}}, "warning", "no-fix", "tag t1 has no fix"),
        ({"silent": {"t1", "t2"}}, "bad", "no-fixes", "no positions, although 2 tags are online"),
    ],
)
def test_a_fault_is_reported_within_4_s_and_gone_within_7(hall, change, level, kind, words):
    before = {name: getattr(hall, name) for name in change}
    for name, value in change.items():
        setattr(hall, name, value)
    if kind == "anchors":
        hall.used = tuple(anchor for anchor in IDS if anchor not in hall.silent)
    condition = hall.run(4.01)
    assert condition.level == level
    found = next(reason for reason in condition.reasons if reason.kind == kind)
    assert words in found.text
    assert found.advice
    for name, value in before.items():
        setattr(hall, name, value)
    assert hall.run(7.0).level == "good"


def test_a_tag_is_not_missed_before_its_first_fix_could_have_come():
    hall = Hall(("rare",)).start()
    hall.silent, hall.tags = {"rare"}, {"rare": {"interval_s": 60.0}}
    hall.run(149.0)
    assert hall.monitor.evaluate(hall.now_s).reasons == ()
    assert hall.run(3.0).reasons[0].kind == "no-fixes"


def test_a_tag_that_wakes_a_little_late_is_not_missed():
    hall = Hall(("t1",)).start()
    hall.run(10.0)
    hall.tags = {"t1": {"sleeps_s": 20.0}}
    hall.run(0.2)
    hall.silent = {"t1"}
    health = hall.evidence.table.get("tag", "t1").health
    hall.evidence.add_health("tag", "t1", health, hall.now_s, 1e9 + hall.now_s)
    reasons = []
    for _ in range(49):
        hall.now_s += 0.5
        reasons += hall.monitor.evaluate(hall.now_s).reasons
    assert not [reason for reason in reasons if reason.kind in ("no-fix", "no-fixes")]
    hall.now_s += 2.0
    assert "no-fixes" in [reason.kind for reason in hall.monitor.evaluate(hall.now_s).reasons]


def test_each_tag_has_the_cause_that_it_gives():
    """Of some tags, then of all."""
    hall = Hall(("t1", "t2", "t3", "t4")).start()
    hall.run(10.0)
    hall.tags = {"t1": {"reason": "bad-geometry"}, "t2": {"reason": "no-beacons"}, "t3": {"reason": "no-beacons"}}
    hall.silent = {"t1", "t2", "t3"}
    reason = hall.run(4.0).reasons[0]
    assert reason.names == ("tag/t1", "tag/t2", "tag/t3")
    assert reason.text == "tags t1, t2 and t3 have no fix: no beacons (tags t2 and t3); bad geometry (tag t1)"
    assert reason.advice.startswith("For tags t2 and t3: It receives no anchor")
    hall.silent = {"t1", "t2", "t3", "t4"}
    text = hall.run(4.0).reasons[0].text
    assert text == "no positions, although 4 tags are online: no beacons (tags t2 and t3); bad geometry (tag t1)"
    hall.tags = {name: {"reason": "no-beacons"} for name in hall.silent}
    assert hall.run(4.0).reasons[0].text == "no positions, although 4 tags are online: no beacons"


def test_each_tag_has_its_own_alert():
    evidence = Evidence(SiteTable(0.0, HOST))
    alerts = ("detected-not-excluded", "alert-limit-exceeded", "detected-excluded", "none")
    for number, alert in enumerate(alerts, 1):
        name = f"t{number}"
        evidence.add_fix(fix(name, alert=alert), 0.0, 1000.0)
    assert [reason.text for reason in alert_reasons(evidence)] == [
        "tag t1: a fault is not excluded, so that the position may be wrong; "
        "tag t2: the protection level is above the alert limit",
        "tag t3: a faulty anchor is excluded",
    ]


def test_tags_that_drop_old_receptions_are_named_with_their_number(hall):
    for k in range(1, 4):
        hall.tags = {"t2": {"late": 50 * k}}
        condition = hall.run(1.0)
    assert condition.text == "this computer is too slow: tag t2 dropped 50 receptions or fixes that were too old"
    assert hall.run(HOLD_S + 2.0).level == "good"


def test_a_computer_with_little_to_do_is_not_too_slow(hall):
    """As measured: it misses some of its transmissions in most seconds."""
    hall.air, hall.anchors = {"missed_share": 0.04}, {"missed_share": 0.09}
    assert hall.run(5.0).level == "good"


@pytest.mark.parametrize("error_s", [-7200.0, -3.0, 12.5])
def test_the_clock_of_another_computer_raises_no_alarm_but_a_growing_delay_does(error_s):
    hall = Hall()
    hall.host, hall.clock_error_s = "pi7", error_s
    assert hall.start().run(10.0).level == "good"
    hall.clock_error_s += 2.0  # set back
    assert hall.run(3.0).level == "good"
    hall.silent = set(hall.names)  # messages wait, in their order
    hall.run(1.5)
    hall.silent, hall.delay_s = set(), 1.5
    reason = hall.run(1.0).reasons[0]
    assert reason.text.startswith("positions are 1.5 s behind")
    assert "not by its clock" in reason.advice


def test_a_delay_of_this_computer_is_found_even_if_it_was_there_from_the_start():
    hall = Hall()
    hall.delay_s = 1.5
    assert hall.start().run(4.0).text.startswith("positions are 1.5 s behind")


def test_a_master_that_changes_often_is_reported(hall):
    for term in range(1, 4):
        hall.anchors = {"master": 1 + term, "term": term}
        condition = hall.run(4.0)
        assert (condition.level == "warning") == (term == 3)
    assert condition.text == "the master has changed 3 times within a minute; now it is anchor 4"


def test_findings_of_the_watch(hall):
    moved = WatchFinding("moved", (4,), 0.11, 0.01, 1.0, "anchor 4 has moved by about 11 cm.")
    hall.watch = WatchMessage(1.0, "watching", (moved, replace(moved, kind="delay", sentence="delay of 4")), 15), 1.0
    condition = hall.run(0.5)
    assert [(reason.kind, reason.level) for reason in condition.reasons] == [("moved", "bad"), ("watch", "warning")]
    hall.watch = hall.watch[0], 300.0
    hall.run(HOLD_S)
    assert "does not report any more" in hall.run(1.0).text


def test_tags_that_batches_have_no_longer_are_named_while_silence_means_something_and_then_forgotten():
    hall = Hall(()).start()

    def hear(seconds, *tags):
        for _ in range(round(2 * seconds)):
            unix_s = 1e9 + hall.now_s
            for tag in tags:
                hall.evidence.add_fix(fix(tag, unix_s), hall.now_s, unix_s, batched=True)
            hall.table.hear(tags, hall.now_s)
            hall.table.tick(hall.now_s)
            condition = hall.run(0.5)
        return {reason.kind: reason for reason in condition.reasons}

    assert hear(12.0, "t1", "t2") == {}
    silent = hear(THRESHOLDS.gone_s + 1.0, "t1")["silent"]
    assert ("t2" in silent.text, silent.names) == (True, ("tag/t2",))
    hall.table.set_connected(connected=False, now_s=hall.now_s, batches=True)
    assert "silent" not in hear(10.0)
    hall.table.set_connected(connected=True, now_s=hall.now_s, batches=True)
    assert "no-fixes" in hear(THRESHOLDS.gone_s + 1.0)
    hall.now_s += THRESHOLDS.longest_s
    assert hear(4.0) == {}


def test_a_stall_of_the_server_blames_no_anchor(hall):
    hall.now_s += 8.0  # nothing could be read meanwhile
    condition = hall.monitor.evaluate(hall.now_s, 8.0)
    assert [reason.kind for reason in condition.reasons] == ["slow"]
    assert hall.run(HOLD_S + 1.5).level == "good"


TIMES = st.floats(0.0, 4.0)
MESSAGES = st.one_of(
    st.tuples(st.just("connected"), st.booleans()),
    st.tuples(st.just("status"), st.sampled_from(["anchor", "tag"]), st.sampled_from(["1", "2", "t1"]), st.booleans()),
    st.tuples(st.just("fix"), st.sampled_from(["t1", "t2"]), st.floats(0.0, 3.0)),
    st.tuples(st.just("anchor"), st.sampled_from(IDS), st.booleans()),
    st.tuples(st.just("tag"), st.sampled_from(["t1", "t2"]), st.integers(0, 900)),
    st.tuples(st.just("evaluate"), st.floats(0.0, 1.0)),
)


@given(st.lists(st.tuples(TIMES, MESSAGES), max_size=40))
def test_the_condition_is_never_good_without_fresh_evidence(steps):
    now_s, connected = 0.0, False
    table = SiteTable(now_s, HOST, connected=False)
    evidence = Evidence(table)
    monitor = ConditionMonitor(evidence)
    table.set_site(SITE.site, now_s)
    for wait_s, (kind, *given_values) in steps:
        now_s += wait_s
        if kind == "connected":
            (connected,) = given_values
            table.set_connected(connected=connected, now_s=now_s)
        elif kind == "status":
            node_kind, name, online = given_values
            evidence.add_status(status(node_kind, name, online), now_s)
        elif kind == "fix":
            name, latency_s = given_values
            evidence.add_fix(fix(name, now_s - latency_s, latency_s=latency_s), now_s, now_s)
        elif kind == "anchor":
            anchor, synchronised = given_values
            health = anchor_health(anchor, now_s, synchronised=synchronised)
            evidence.add_health("anchor", str(anchor), health, now_s, now_s)
        elif kind == "tag":
            name, late = given_values
            evidence.add_health("tag", name, tag_health(name, unix_s=now_s, late=late), now_s, now_s)
        condition = monitor.evaluate(now_s, given_values[0] if kind == "evaluate" else 0.0)
        assert condition.level in {"waiting", "good", "warning", "bad"}
        assert (condition.level in {"warning", "bad"}) == bool(condition.reasons)
        assert condition.level == "good" or condition.text
        if condition.level == "good":
            assert connected
            tags = table.fixed.values()
            assert any(now_s - tag.fix_s < table.fresh_for_s(tag) for tag in tags)
