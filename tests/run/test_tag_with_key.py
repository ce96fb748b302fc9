"""The tag's program with a site's public key: which fixes it gives, what it says and what it remembers."""

import numpy as np
import pytest
from keyed_site import FIRST, FREE, KEYS, OTHER_KEYS, tape
from msgspec.structs import replace
from node_stage import PLACE_M, FakeRadio

from skyless.core.air.beacon import decode
from skyless.core.air.frame import Reception
from skyless.core.trusted_receiver import SiteTrust, Trust
from skyless.radio.interface import Restarted
from skyless.run.keys import UNVERIFIED_S, Remembered, TagMemory
from skyless.run.mqtt.messages import Counters
from skyless.run.tag import TagNode, TagSettings
from support.keyed_air import START_UNIX_S

pytestmark = pytest.mark.site

SITE_TRUST = SiteTrust(FREE.id, KEYS.public, 1, Trust.VERIFIED)


class Bench:
    def __init__(self, trust=SITE_TRUST, *, ahead_s=0.0, memory=None):
        self.published, self.said = [], []
        self.now_s = 0.0
        settings = TagSettings(site=FREE.id, publish_hz=1000.0, trust=trust)
        self.node = TagNode(
            settings, FakeRadio("t1"), self.published.append, self.said.append, clock=lambda: self.now_s, memory=memory
        )
        self.node.fix_log.unix_less_host_s = START_UNIX_S + ahead_s

    def hear(self, heard):
        """Receptions that are processed as soon as they have ended, and what is done every second."""
        for reception in heard:
            if int(reception.host_s) > int(self.now_s):
                self.node.check_trust()
            self.now_s = reception.host_s
            self.node.on_event(reception)
        self.node.check_trust()
        return self

    def health(self):
        log = self.node.fix_log
        fields = {"method": "joint", "receptions": 1, "reason": self.node.reason, "counters": self.node.drops}
        return self.node.complete(log.health(**fields, mqtt=Counters(0, 0, 0), cpu=0.0, memory_bytes=0))


def are_right(fixes):
    return len(fixes) > 100 and all(np.linalg.norm(np.subtract(fix.position_m, PLACE_M)) < 0.3 for fix in fixes[50:])


def test_verified_fixes_come_later_and_are_not_withheld_for_that():
    bench = Bench().hear(tape())
    assert are_right(bench.published)
    assert {fix.unverified for fix in bench.published} == {0.0}
    assert all(fix.verified_until_s == fix.time_s for fix in bench.published)
    latencies_s = [fix.latency_s for fix in bench.published]
    assert min(latencies_s) > 0.1
    assert 0.3 < max(latencies_s) < 0.7
    ends = {reception.host_s + START_UNIX_S for reception in tape()}
    assert {fix.unix_s for fix in bench.published} <= ends
    times = [fix.unix_s for fix in bench.published]
    assert times == sorted(set(times))
    assert bench.node.fix_log.lateness.withheld == 0
    health = bench.health()
    assert (health.trust, health.is_verified, health.faults, health.clock_error_s) == ("verified", True, {}, None)
    assert bench.said == [f"tag t1: beacons of site {FREE.id} are verified (key chain 1)"]


def test_open_fixes_come_at_once_and_state_how_far_they_are_verified():
    bench = Bench(replace(SITE_TRUST, trust=Trust.OPEN)).hear(tape())
    assert are_right(bench.published)
    assert max(fix.latency_s for fix in bench.published) == 0.0
    late = bench.published[-100:]
    assert all(0.0 < fix.unverified < 0.7 and 0.3 < fix.time_s - fix.verified_until_s < 0.7 for fix in late)
    assert bench.health().trust == "open"


@pytest.mark.statistical
def test_an_anchor_that_is_refused_for_long_is_named_once():
    forged = [one for one in tape(12.0, OTHER_KEYS.chains) if decode(one.frame).anchor == 3 and one.host_s > 2.0]
    bench = Bench().hear(sorted((*tape(12.0), *forged), key=lambda one: one.host_s))
    assert bench.health().faults == {"3": "bad-code"}
    assert are_right(bench.published)
    assert [line for line in bench.said if "not accepted" in line] == [
        "tag t1: beacons of anchor 3 are not accepted: their codes are wrong: it has a wrong seed, or somebody forges "
        "its beacons"
    ]


def test_a_tag_without_a_key_computes_as_before():
    bench = Bench(None).hear(tape())
    assert are_right(bench.published)
    assert {(fix.verified_until_s, fix.unverified) for fix in bench.published} == {(None, 1.0)}
    health = bench.health()
    assert (health.trust, health.is_verified) == (None, False)


@pytest.mark.parametrize(
    ("case", "reason", "words"),
    [
        ("no codes", "no-code", "the beacons carry no codes"),
        ("other key", "no-certificate", "no certificate of the site's key was received"),
        ("ahead", "clock-wrong", "this host's clock is 5.0 s ahead of site"),
        ("behind", "clock-wrong", "this host's clock is 5.0 s behind site"),
    ],
)
@pytest.mark.statistical
def test_why_nothing_is_verified_is_said_once(case, reason, words):
    trust = replace(SITE_TRUST, public=OTHER_KEYS.public) if case == "other key" else SITE_TRUST
    ahead_s = {"ahead": 5.0, "behind": -5.0}.get(case, 0.0)
    bench = Bench(trust, ahead_s=ahead_s)
    bench.hear(tape(UNVERIFIED_S + 3.0, () if case == "no codes" else (FIRST,)))
    assert bench.published == []
    health = bench.health()
    assert (health.reason, health.is_verified) == (reason, False)
    if ahead_s:
        assert health.clock_error_s == pytest.approx(ahead_s, abs=0.5)
    assert len([line for line in bench.said if words[:-12] in line]) == 1, bench.said


def test_nothing_is_said_of_an_anchor_that_is_refused_for_a_moment():
    forged = tape(1.5, OTHER_KEYS.chains)[-20:]
    bench = Bench().hear(sorted((*tape(), *forged), key=lambda one: one.host_s))
    assert bench.node.drops["bad-code"] > 0
    assert are_right(bench.published)
    assert [line for line in bench.said if "not accepted" in line] == []


def test_what_is_known_of_keys_lasts_over_a_restart_of_the_radio_and_of_the_program(tmp_path):
    memory = TagMemory(SITE_TRUST, tmp_path)
    bench = Bench(memory=memory).hear(tape())
    again = TagMemory(SITE_TRUST, tmp_path)
    assert again.remembered.serial == FIRST.serial
    assert again.remembered.certificates
    bench.node.on_event(Restarted())
    assert not bench.health().is_verified
    assert bench.node._trusted.verifier.keys.certificates == again.remembered.certificates
    fresh = Bench(memory=again)
    begun = fresh.node._trusted.verifier.keys
    assert (begun.serial, begun.certificates) == (again.remembered.serial, again.remembered.certificates)


def test_a_revoked_chain_stays_revoked_over_a_restart(tmp_path):
    TagMemory(SITE_TRUST, tmp_path).keep(2, ())
    bench = Bench(memory=TagMemory(SITE_TRUST, tmp_path)).hear(tape())
    assert bench.published == []
    assert bench.node.drops["revoked-chain"] > 0


def test_the_serial_number_never_becomes_lower(tmp_path):
    first, second = TagMemory(SITE_TRUST, tmp_path), TagMemory(SITE_TRUST, tmp_path)
    first.keep(7, [])
    second.keep(3, [])
    assert TagMemory(SITE_TRUST, tmp_path).remembered.serial == 7
    other = TagMemory(replace(SITE_TRUST, public=OTHER_KEYS.public), tmp_path)
    assert other.remembered == Remembered()


@pytest.mark.parametrize(
    "damage", [b"", b"{", b"[]", b'{"serial":70000}', b'{"serial":1,"certificates":["AAAA"]}', b"\xff"]
)
def test_a_damaged_memory_is_as_good_as_none(tmp_path, damage):
    memory = TagMemory(SITE_TRUST, tmp_path)
    memory.keep(1, [])
    memory.file.write_bytes(damage)
    again = TagMemory(SITE_TRUST, tmp_path)
    assert again.remembered == Remembered()
    assert are_right(Bench(memory=again).hear(tape()).published)
    assert TagMemory(SITE_TRUST, tmp_path).remembered.serial == FIRST.serial


def test_a_folder_that_cannot_be_written_costs_no_fix(tmp_path):
    (tmp_path / "trust").write_bytes(b"a file where the folder would be")
    assert are_right(Bench(memory=TagMemory(SITE_TRUST, tmp_path)).hear(tape()).published)


def test_receptions_without_a_time_use_the_present(monkeypatch):
    bench = Bench()
    for one in tape():
        bench.now_s = one.host_s
        monkeypatch.setattr("time.time", lambda one=one: START_UNIX_S + one.host_s)
        bench.node.on_event(Reception(one.frame, one.rx_ticks, None, one.diagnostics))
    assert bench.health().is_verified
    assert bench.node.fix_log.serial == Bench().hear(tape()).node.fix_log.serial
