"""What targets get: usable fixes at their rate, that there is none, and nothing else's faults."""

from math import nan

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from skyless.bridges.target import (
    MIN_STD_M,
    Hub,
    Route,
    Target,
    bridged_site,
    floored,
    is_usable,
    open_hub,
    require_georeference,
)
from skyless.core.alert import Alert
from skyless.core.errors import SkylessError
from skyless.run.mqtt.messages import StatusMessage
from skyless.sim.lab import lab_site
from support.bridged_values import BARE_SITE, SITE, a_fix, covariances
from support.site_messages import tag_health


class Recorded(Target):
    """Keeps what it gets."""

    def __init__(self, text="test:", *, one_tag=False, needs_earth=False):
        super().__init__(text)
        self.one_tag, self.needs_earth = one_tag, needs_earth
        self.fixes, self.none, self.gone, self.states, self.seconds = [], [], [], [], 0

    def on_site(self, site):
        if self.needs_earth:
            require_georeference(site, self.text)

    def on_fix(self, fix):
        self.fixes.append(fix)

    def on_no_fix(self, tag, unix_s, reason):
        self.none.append((tag, unix_s, reason))

    def on_gone(self, tag, unix_s):
        self.gone.append((tag, unix_s))

    def on_second(self, unix_s):
        self.seconds += 1

    def on_health(self, health):
        self.states.append(health.tag)

    def on_status(self, status):
        self.states.append(status.name)


def hub_of(*targets, hz=1000.0, tag=None, said=None):
    hub = Hub([Route(target, tag, hz) for target in targets], (said if said is not None else []).append)
    hub.on_site(SITE)
    return hub


def test_fixes_come_at_the_rate_of_each_target_and_tag():
    slow, fast = Recorded("slow"), Recorded("fast")
    hub = Hub([Route(slow, None, 10.0), Route(fast, "tag2", 1000.0)], print)
    hub.on_site(SITE)
    for step in range(1000):  # ten seconds at 100 Hz for each of two tags
        for name in ("tag1", "tag2"):
            hub.on_fix(a_fix(tag=name, serial=step), 50.0 + 0.01 * step)
    assert [sum(fix.tag == name for fix in slow.fixes) for name in ("tag1", "tag2")] == [
        101,
        101,
    ]  # the second may come half an interval early
    assert [fix.serial for fix in fast.fixes] == list(range(1000))
    assert {fix.tag for fix in fast.fixes} == {"tag2"}
    assert hub.fixes == 2000


def test_before_the_site_is_known_nothing_is_given():
    target = Recorded()
    hub = Hub([Route(target, None, 10.0)], print)
    hub.on_fix(a_fix(), 1.0)
    hub.on_tick(9.0, 9.0)
    assert (target.fixes, target.none, target.seconds) == ([], [], 1)


@pytest.mark.parametrize(
    "changes",
    [
        {"alert": Alert.LIMIT.value},
        {"alert": Alert.NOT_EXCLUDED.value},
        {"position_m": (nan, 0.0, 0.0)},
        {"covariance_m2": (nan,) * 9},
    ],
)
def test_unusable_fixes_count_as_none_and_are_never_given(changes):
    target = Recorded()
    hub = hub_of(target)
    hub.on_fix(a_fix(), 10.0)
    for step in range(1, 50):
        hub.on_fix(a_fix(serial=step + 1, **changes), 10.0 + 0.1 * step)
        if step % 10 == 0:
            hub.on_tick(10.0 + 0.1 * step, 500.0 + 0.1 * step)
    assert len(target.fixes) == 1
    assert [when_s for _, when_s, _ in target.none] == [503.0, 504.0]
    assert {reason for _, _, reason in target.none} == {changes.get("alert") or "position is not finite"}


@pytest.mark.parametrize("alert", [None, Alert.NONE.value, Alert.EXCLUDED.value, Alert.UNAVAILABLE.value])
def test_alerts_that_do_not_forbid_the_use_of_a_fix(alert):
    assert is_usable(a_fix(alert=alert))


def test_a_tag_without_a_fix_is_reported_each_second_until_it_has_one_or_is_forgotten():
    target = Recorded()
    hub = hub_of(target)
    hub.on_fix(a_fix(), 0.0)
    hub.on_tick(2.4, 102.4)
    assert target.none == []
    for second in (3, 4):
        hub.on_tick(float(second), 100.0 + second)
    assert target.none == [("tag1", 103.0, "no fix"), ("tag1", 104.0, "no fix")]
    hub.on_fix(a_fix(serial=2), 4.5)
    hub.on_tick(5.0, 105.0)
    assert len(target.none) == 2
    hub.on_tick(2000.0, 2100.0)
    assert target.gone == [("tag1", 2100.0)]
    hub.on_tick(100_000.0, 100_100.0)
    hub.on_tick(100_001.0, 100_101.0)
    assert len(target.none) == 3, "a tag that left a day ago is not spoken of"


def test_no_fix_of_a_tag_at_the_targets_own_rate_is_missed_because_it_came_early():
    target = Recorded()
    hub = hub_of(target, hz=50.0)
    for step in range(500):
        hub.on_fix(a_fix(serial=step), 10.0 + 0.02 * step + (0.004 if step % 3 else -0.004))
    assert len(target.fixes) == 500


def test_a_target_for_one_tag_keeps_to_the_first_and_says_so_once():
    said = []
    target = Recorded(one_tag=True)
    hub = hub_of(target, said=said)
    for step in range(3):
        hub.on_fix(a_fix(tag="tag1", serial=step), float(step))
        hub.on_fix(a_fix(tag="tag2", serial=step), float(step))
    hub.on_tick(9.0, 9.0)
    assert {fix.tag for fix in target.fixes} == {"tag1"}
    assert {tag for tag, _, _ in target.none} == {"tag1"}
    assert said == ["test: carries one tag, tag1; ?tag=NAME chooses another, as tag2"]


def test_a_tag_that_has_never_had_a_fix_does_not_hold_a_target_for_one_tag():
    target = Recorded(one_tag=True)
    hub = hub_of(target)
    hub.on_health(tag_health("tag1"), 0.0)
    hub.on_tick(3.0, 103.0)
    assert [tag for tag, _, _ in target.none] == ["tag1"]
    hub.on_fix(a_fix(tag="tag2"), 3.1)
    hub.on_tick(3.9, 103.9)
    assert [fix.tag for fix in target.fixes] == ["tag2"]
    assert len(target.none) == 1, "it is another tag's now"


def test_a_target_that_is_for_one_tag_by_the_users_choice_gets_no_other_tags_state():
    target, all_tags = Recorded(), Recorded("all:")
    hub = Hub([Route(target, "tag1", 50.0), Route(all_tags, None, 50.0)], print)
    for tag in ("tag1", "tag2"):
        hub.on_health(tag_health(tag), 0.0)
        hub.on_status(StatusMessage(True, "tag", tag), 0.0, 0.0)
    hub.on_status(StatusMessage(True, "anchor", "2"), 0.0, 0.0)
    assert target.states == ["tag1", "tag1", "2"]
    assert all_tags.states == ["tag1", "tag1", "tag2", "tag2", "2"]


def test_a_fault_in_one_target_costs_the_others_nothing_and_is_logged_once():
    class Broken(Recorded):
        def on_fix(self, fix):
            raise RuntimeError("out of order")

    said = []
    broken, sound = Broken("broken:"), Recorded("sound:")
    hub = hub_of(broken, sound, said=said)
    for step in range(5):
        hub.on_fix(a_fix(serial=step), float(step))
    assert len(sound.fixes) == 5
    assert len(said) == 1
    assert "broken: failed (RuntimeError('out of order'))" in said[0]


def test_a_site_without_georeference_is_refused_with_the_keys_to_add():
    said = []
    earthly, other = Recorded("earthly:", needs_earth=True), Recorded("other:")
    alone = Hub([Route(Recorded("earthly:", needs_earth=True), None, 10.0)], print)
    with pytest.raises(SkylessError, match=r"\[georeference\] with latitude_deg, longitude_deg, height_m"):
        alone.on_site(BARE_SITE)
    hub = Hub([Route(earthly, None, 10.0), Route(other, None, 10.0)], said.append)
    for anchor in range(5):  # a site that grows
        hub.on_site(structs.replace(BARE_SITE, anchors_m={anchor: (1.0, 0.0, 2.0)}))
    hub.on_fix(a_fix(), 1.0)
    hub.on_tick(4.0, 4.0)
    assert (len(earthly.fixes), len(other.fixes), len(earthly.none), len(other.none)) == (0, 1, 0, 1)
    assert len(said) == 1
    assert "earthly:" in said[0]
    hub.on_site(SITE)
    hub.on_fix(a_fix(serial=2), 4.0)
    assert len(earthly.fixes) == 1, "a survey or a new file may add it while all run"


def test_the_same_target_twice_is_refused():
    with pytest.raises(SkylessError, match="given twice"):
        open_hub([Route(Recorded(), None, 1.0), Route(Recorded(), None, 1.0)], print)


@given(covariances())
def test_no_variance_is_smaller_than_the_floor_and_none_becomes_smaller(covariance):
    raised = floored(covariance)
    for index in (0, 4, 8):
        assert raised[index] >= max(covariance[index], MIN_STD_M**2)
    assert [raised[i] for i in (1, 2, 3, 5, 6, 7)] == [covariance[i] for i in (1, 2, 3, 5, 6, 7)]


@given(st.booleans())
def test_a_site_of_a_file_keeps_what_bridges_need(simulated):
    site = lab_site()
    made = bridged_site(site, simulated=simulated)
    assert (made.id, made.name, made.simulated) == (site.id, site.name, simulated)
    assert made.anchors_m == {one.id: (one.x_m, one.y_m, one.z_m) for one in site.anchors}
    assert structs.replace(made, zones=()) == made
