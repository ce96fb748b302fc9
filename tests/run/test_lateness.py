"""A tag on a computer that is too slow: nothing old is given, what is dropped is counted, and it goes on at once."""

import itertools
import math
from dataclasses import dataclass, field

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from node_stage import PLACE_M, FakeRadio, receptions

from skyless.core.air.frame import Diagnostics, Reception
from skyless.core.any_receiver import AnyReceiver
from skyless.run.fix_log import FIX_LEAVES_S, MAX_AGE_S, MAX_RECEPTION_AGE_S, Lateness
from skyless.run.mqtt.messages import Counters, RequestMessage
from skyless.run.recordings.reception_log import ReceptionLog, receiver_settings
from skyless.run.tag import TagNode, TagSettings

pytestmark = pytest.mark.site

HEARD = receptions(1.5)
UNIX_S = 1e9
REST_MS = 30
"""Longest of the many short delays."""


@dataclass
class SlowHost:
    """A tag whose program gets its turns late, and takes its time for each."""

    tag_settings: TagSettings = field(default_factory=lambda: TagSettings(publish_hz=1e9))
    now_s: float = 0.0
    work_s: float = 0.0
    """What a reception takes from its turn to its fix."""

    def __post_init__(self):
        self.published, self.ages_s, self.processed = [], [], []
        self.log = ReceptionLog("t1", receiver_settings(self.tag_settings.method), "run")
        self.log.request(RequestMessage("test", ("t1",), 1e6), 0.0)
        self.node = TagNode(
            self.tag_settings, FakeRadio("t1"), self._publish, print, self._before, clock=lambda: self.now_s
        )
        self.node.fix_log.unix_less_host_s = UNIX_S

    def _before(self, receiver, reception):
        self.log.add(receiver, reception)
        self.processed.append(reception)
        self.now_s += self.work_s

    def _publish(self, fix):
        self.published.append(fix)
        self.ages_s.append(self.now_s + UNIX_S - fix.unix_s)

    def receive(self, reception, delay_s=0.0, work_s=0.0):
        """Its turn comes when it has ended and the program has done what came before, and so much later."""
        self.now_s, self.work_s = max(self.now_s, reception.host_s) + delay_s, work_s
        self.node.on_event(reception)

    def health(self):
        self.node.fix_log.update_clock_offset = lambda: None
        return self.node.fix_log.health(
            method="joint",
            receptions=self.node.receptions,
            reason="-",
            counters=self.node.drops,
            mqtt=Counters(0, 0, 0),
            cpu=0.0,
            memory_bytes=0,
        )


MILLISECONDS = st.one_of(st.integers(0, 2), st.integers(0, REST_MS), st.integers(0, 400))
PAUSES = st.dictionaries(st.integers(0, len(HEARD) - 1), st.tuples(MILLISECONDS, MILLISECONDS), max_size=30)


def slowed(pauses, each_us):
    """A host that has received all, with these pauses before and at the work for some."""
    host = SlowHost()
    for number, reception in enumerate(HEARD):
        delay_ms, work_ms = pauses.get(number, (0, 0))
        host.receive(reception, 1e-3 * delay_ms, 1e-6 * each_us + 1e-3 * work_ms)
    return host


@settings(max_examples=20)
@given(PAUSES, st.integers(0, 8000))
@pytest.mark.statistical
def test_no_fix_that_is_given_is_too_old_and_the_counts_add_up(pauses, each_us):
    host = slowed(pauses, each_us)
    assert all(age_s <= FIX_LEAVES_S + 1e-6 for age_s in host.ages_s)
    health = msgspec.json.decode(msgspec.json.encode(host.health()))
    late = {name: health["counters"].get(name, 0) for name in ("late-reception", "late-fix")}
    assert health["receptions"] == len(HEARD) == len(host.processed) + late["late-reception"]
    assert health["fixes"] == len(host.published) + late["late-fix"]
    assert health["late"] == sum(late.values())
    assert (health["lateness_s"] > MAX_RECEPTION_AGE_S) >= bool(health["late"])
    assert host.health().lateness_s == 0.0


@settings(max_examples=10)
@given(PAUSES, st.integers(0, 8000))
def test_a_recording_of_a_slow_tag_gives_its_fixes_again_bit_for_bit(pauses, each_us):
    """What was dropped is not in the recording, as the receiver never had it."""
    host = slowed(pauses, each_us)
    recorded = []
    while (message := host.log.collect(1e3 + len(recorded), UNIX_S)) is not None:
        recorded += message.receptions
    again = AnyReceiver(host.tag_settings.method)
    fixes = [
        fix
        for raw in recorded
        if (fix := again.hear(Reception(raw.frame, raw.rx_ticks, raw.host_s, diagnostics_of(raw)))) is not None
    ]
    assert len(fixes) == host.node.fix_log.serial
    for published in host.published:
        assert published.position_m == tuple(fixes[published.serial - 1].position_m.tolist())


def diagnostics_of(raw):
    if raw.rx_power_dbm is None:
        return None
    return Diagnostics(raw.rx_power_dbm, raw.first_path_power_dbm, raw.carrier_offset_ppm)


@pytest.mark.parametrize("method", ["joint", "weighted"])
def test_after_a_pause_all_that_waits_is_dropped_and_what_comes_then_gives_fixes_again(method):
    host = SlowHost(TagSettings(method, publish_hz=1e9))
    pause_s, number = 0.3, next(n for n, reception in enumerate(HEARD) if reception.host_s > 1.0)
    for reception in HEARD[:number]:
        host.receive(reception)
    before = len(host.published)
    host.receive(HEARD[number], pause_s)
    for reception in HEARD[number + 1 :]:
        host.receive(reception)
    waited = sum(HEARD[number].host_s <= reception.host_s <= HEARD[number].host_s + pause_s for reception in HEARD)
    assert host.node.fix_log.lateness.dropped == waited > 100
    assert host.processed == HEARD[:number] + HEARD[number + waited :]
    later = host.published[before:]
    assert later[0].unix_s - UNIX_S - host.processed[number].host_s < 0.1  # at once, or after some superframes
    assert all(np.linalg.norm(np.subtract(fix.position_m, PLACE_M)) < 6.0 * fix.std_m < 1.0 for fix in later)


def test_a_program_that_is_always_too_slow_goes_from_backlog_to_backlog():
    """It needs twice the time that there is: half of the receptions are processed, in runs, and none is very late."""
    host = SlowHost()
    work_s = 2.0 * (HEARD[-1].host_s - HEARD[0].host_s) / len(HEARD)
    for reception in HEARD:
        host.receive(reception, 0.0, work_s)
    numbers = [HEARD.index(reception) for reception in host.processed]
    runs = 1 + sum(after - before > 1 for before, after in itertools.pairwise(numbers))
    assert 0.4 < len(numbers) / len(HEARD) < 0.6
    assert len(numbers) / runs > 6  # a superframe and more
    assert max(host.ages_s) < MAX_RECEPTION_AGE_S + 2.0 * work_s
    assert host.published[-1].unix_s > UNIX_S + HEARD[-1].host_s - MAX_AGE_S


def test_a_tag_whose_receptions_are_all_old_logs_why():
    logged = []
    node = TagNode(TagSettings(), FakeRadio("t1"), lambda fix: None, logged.append, clock=lambda: 100.0)
    node.monitor.restarts, node.monitor._present = 1, True
    node.check_reception(999.0)
    for reception in HEARD:
        node.on_event(reception)
    node.check_reception(1005.0)
    (line,) = logged
    assert line.endswith(
        f"most counted: late-reception ({len(HEARD)}), those were too old at their turn: this computer is too slow"
    )


def test_what_comes_from_a_clock_that_is_ahead_is_not_late():
    lateness = Lateness()
    assert lateness.admits(10.0, 9.0)
    assert lateness.gives(10.0, 9.0)
    assert lateness.drain() == 0.0


TIMES = st.floats(0.0, 10.0)


@given(st.lists(st.tuples(TIMES, TIMES), min_size=1, max_size=50))
def test_whatever_the_times_an_old_reception_is_never_admitted_and_the_end_of_a_backlog_is(times):
    lateness = Lateness()
    oldest_s, now_s = 0.0, 0.0
    for pass_s, age_s in times:
        now_s += pass_s
        admitted = lateness.admits(now_s - age_s, now_s)
        assert not (admitted and now_s - (now_s - age_s) > MAX_RECEPTION_AGE_S)
        oldest_s = max(oldest_s, now_s - (now_s - age_s))
    assert math.isclose(lateness.drain(), oldest_s)
    assert lateness.admits(now_s + 1e-3, now_s + 1e-3)
