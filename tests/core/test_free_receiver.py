"""A tag at a site of protocol 2: what it learns from beacons alone, and what cannot disturb it."""

from itertools import pairwise

import numpy as np
import pytest
from free_site import FREE, beacon_of, free_tape, with_beacon
from msgspec.structs import replace

from skyless.core.air.almanac import NoisePage, SitePage, period_code
from skyless.core.air.beacon import StatedPosition, encode
from skyless.core.air.frame import Heard as Relay
from skyless.core.air.site_pages import site_issue
from skyless.core.any_receiver import AnyReceiver
from skyless.core.fix import NoFixReason
from skyless.core.pages import site_page_for, site_pages_of
from skyless.core.site import GeoreferenceSite
from skyless.core.tag.receiver import NOT_DROPS, Receiver
from skyless.core.ticks import from_seconds, wrap
from support.bench import Heard, assert_honest, tape

pytestmark = pytest.mark.site

STRANGER = 999
ANCHORS = len(FREE.anchors)


def fixes_of(receiver, heard):
    """Rows of the fixes, by the frames that made them."""
    made = {}
    for one in heard:
        fix = receiver.hear(one.reception)
        if fix is not None:
            made[one.frame, one.rx_ticks] = fix.rows
    return made


def drops(receiver):
    return {reason for reason in receiver.counters if reason not in NOT_DROPS}


def false_frames(rate_hz, make, seconds=2.0, first_s=0.0):
    """Frames of an attacker with its own counter that collide with none of the site's; ``make``: number, stamp."""
    tag, falses = free_tape()[0], []
    ends_s = np.array([one.host_s for one in free_tape()])
    for n in range(int((seconds - first_s) * rate_hz)):
        at_s = first_s + (n + 0.37) / rate_hz
        if np.min(np.abs(ends_s - at_s)) < 0.4e-3:
            continue  # the two would collide
        ticks = from_seconds(at_s - tag.host_s)
        beacon = make(n, wrap(12345 + from_seconds(at_s)))
        falses.append(Heard(beacon.anchor, encode(beacon), wrap(tag.rx_ticks + ticks), at_s, tag.truth_m))
    return falses


def merged(*parts):
    return sorted((one for part in parts for one in part), key=lambda one: one.host_s)


def a_beacon(**fields):
    return replace(beacon_of(free_tape()[50]), **{"anchor": STRANGER, "heard": (), "weak": 0, **fields})


def test_a_tag_that_knows_nothing_has_fixes_at_once_and_they_are_honest():
    receiver, made = Receiver(), []
    for one in free_tape():
        fix = receiver.hear(one.reception)
        if fix is not None:
            made.append((one.host_s, fix.time_s))
            assert_honest(fix, one.truth_m)
    assert made[0][0] < 0.3
    times = [time_s for _, time_s in made]
    assert all(later > earlier for earlier, later in pairwise(times))
    assert times[-1] - times[0] == pytest.approx(free_tape()[-1].host_s, abs=0.1)
    assert drops(receiver) <= {"unconfirmed-anchor"}
    assert receiver.site == FREE.id


def test_a_tag_that_is_late_uses_the_newest_relays_as_if_there_were_no_others():
    full, cut, made = Receiver(), Receiver(), []
    for number, one in enumerate(free_tape()):
        beacon = beacon_of(one)
        if number > len(free_tape()) // 2:
            full.tag.most_relays = number % 3
            beacon = replace(beacon, heard=tuple(beacon.heard)[: number % 3], weak=0)
        fixes = full.hear(one.reception), cut.hear_beacon(beacon, one.reception)
        made += [fix.rows for fix in fixes if fix is not None]
    assert len(made) > 1000
    assert made[::2] == made[1::2]


@pytest.mark.parametrize("method", ["literal", "weighted"])
def test_methods_that_need_a_master_give_no_fix(method):
    receiver = AnyReceiver(method)
    assert not fixes_of(receiver, free_tape())
    assert receiver.counters == {"other-version": len(free_tape())}
    assert receiver.reason is NoFixReason.NO_MASTER


def undisturbed(falses, new_receiver=Receiver):
    """Whether a tag has the same fixes with these frames in between, bit for bit; and its counters."""
    expected = fixes_of(Receiver(), free_tape())
    receiver = new_receiver()
    made = fixes_of(receiver, merged(free_tape(), falses))
    assert made == expected
    assert len(expected) > 550
    return receiver.counters


@pytest.mark.parametrize(("new_receiver", "counted"), [(Receiver, "unknown-version"), (AnyReceiver, "foreign-site")])
def test_a_master_of_protocol_1_has_no_effect(new_receiver, counted):
    masters = tape(seconds=1.9)[::30]
    first = min(one.host_s for one in free_tape())
    masters = [one for one in masters if one.host_s > first]
    assert undisturbed(masters, new_receiver)[counted] == len(masters)


def test_a_tag_without_fixes_tries_the_other_protocol():
    """A lone anchor of protocol 2 was there first, then a site of protocol 1, then one of protocol 2."""
    lone = [one for one in free_tape(seconds=0.5) if one.anchor == FREE.anchors[0].id]
    paper = [one for one in tape(seconds=3.0) if one.host_s > 0.5]
    receiver = AnyReceiver()
    assert not fixes_of(receiver, lone)
    made = fixes_of(receiver, paper)
    assert len(made) > 500
    last = paper[-1]
    later = [
        replace(one, rx_ticks=wrap(one.rx_ticks + last.rx_ticks + from_seconds(1.0)), host_s=one.host_s + 4.0)
        for one in free_tape()
    ]
    assert len(fixes_of(receiver, later)) > 100


def test_a_foreign_site_that_was_there_first_does_not_hold_the_tag():
    def foreign(n, tx_ticks):
        return a_beacon(site=77, tx_ticks=tx_ticks, sequence=n & 0xFF, position=None)

    late, receiver = [one for one in free_tape() if one.host_s > 0.5], Receiver()
    made = fixes_of(receiver, merged(late, false_frames(60.0, foreign)))
    assert receiver.site == FREE.id
    first_s = min(one.host_s for one in late if (one.frame, one.rx_ticks) in made)
    assert first_s < 0.5 + 0.3
    assert receiver.counters["site-change"] == 1


def false_page(n, tx_ticks):
    """Of a stranger, under the site's issue and under others."""
    issue = site_issue(site_pages_of(FREE)) if n % 2 else (n * 7919) & 0xFFFF
    page = (SitePage(4, 17.0), NoisePage(1e-6, 1e-6, 1e-7, 1e-7))[n % 2]
    position = StatedPosition(1, 2, 3)
    return a_beacon(tx_ticks=tx_ticks, sequence=n & 0xFF, almanac_issue=issue, page=page, position=position)


def forged_stamp(n, tx_ticks):
    """Under the name of an anchor, so often that between two of its own beacons there may be three."""
    return a_beacon(tx_ticks=tx_ticks, sequence=n & 0xFF, anchor=FREE.anchors[1].id)


def copy_under_another_name(n, _):
    """With all that the anchor has relayed, some milliseconds later."""
    honest = free_tape()[::8]
    beacon = beacon_of(honest[min(n * len(honest) // 80, len(honest) - 1)])
    return replace(beacon, anchor=STRANGER, position=StatedPosition(50.0, 50.0, 1.0), sequence=n & 0xFF)


def another_identifier(n, tx_ticks):
    return a_beacon(tx_ticks=tx_ticks, sequence=0, anchor=1000 + n, almanac_issue=n, page=None)


@pytest.mark.parametrize(
    ("rate_hz", "make", "first_s", "reasons", "least"),
    [
        (40.0, false_page, 0.0, ("unconfirmed-anchor",), 50),
        (120.0, forged_stamp, 0.3, ("impossible-stamp", "duplicate"), 140),
        (40.0, copy_under_another_name, 0.3, ("unconfirmed-anchor", "impossible-stamp"), 40),
        (500.0, another_identifier, 0.0, ("unconfirmed-anchor",), 500),
    ],
)
def test_false_frames_have_no_effect_and_are_counted(rate_hz, make, first_s, reasons, least):
    counters = undisturbed(false_frames(rate_hz, make, first_s=first_s))
    assert sum(counters[reason] for reason in reasons) > least
    assert make is not forged_stamp or counters["anchor-restart"] == 0


def test_one_anchor_that_sends_false_pages_has_no_effect():
    """All that it measures is right, but it states another issue, and other pages."""
    page = SitePage(3, 17.0)
    falses = [
        with_beacon(one, almanac_issue=0xBAD, page=page) if one.anchor == FREE.anchors[2].id else one
        for one in free_tape()
    ]
    receiver = Receiver()
    made = fixes_of(receiver, falses)
    assert list(made.values())[-100:] == list(fixes_of(Receiver(), free_tape()).values())[-100:]
    assert receiver.almanac.pages.site.tag_height_m == FREE.tags.height_m


def test_an_anchor_without_a_position_is_counted_and_its_relays_confirm_others():
    silent = FREE.anchors[0].id
    heard = [with_beacon(one, position=None) if one.anchor == silent else one for one in free_tape()]
    receiver = Receiver()
    made = fixes_of(receiver, heard)
    assert len(made) > 450
    assert receiver.counters["no-position"] > 50
    assert silent not in receiver.method.estimator.anchors


def test_a_moved_anchor_counts_once_it_is_stated_twice_in_a_row():
    moved, heard = FREE.anchors[3].id, free_tape()
    first = next(k for k, one in enumerate(heard) if one.anchor == moved and one.host_s > 1.0)
    once = [
        with_beacon(one, position=StatedPosition(50.0, 50.0, 2.0)) if k == first else one for k, one in enumerate(heard)
    ]
    assert list(fixes_of(Receiver(), once).values()) == list(fixes_of(Receiver(), heard).values())
    there, receiver = StatedPosition(1.0, 2.0, 3.0), Receiver()
    fixes_of(receiver, [with_beacon(one, position=there) if one.anchor == moved else one for one in heard])
    assert receiver.heard_site.anchors_m[moved] == (1.0, 2.0, 3.0)


def test_changed_pages_are_used_when_most_anchors_state_them():
    changed_site = replace(FREE, georeference=GeoreferenceSite(48.0, 11.0, 500.0, 10.0))
    receiver, old, new = Receiver(), free_tape(), free_tape(changed_site)
    made = fixes_of(receiver, [one for one in old if one.host_s < 1.0] + [one for one in new if one.host_s >= 1.0])
    assert receiver.almanac.pages.georeference.latitude_deg == 48.0
    assert len(made) > 550  # nothing that the estimator assumes has changed: it has gone on


def test_another_height_makes_another_method():
    changed, receiver = site_pages_of(replace(FREE, tags=replace(FREE.tags, height_m=0.2))), Receiver()
    fixes_of(receiver, [one for one in free_tape() if one.host_s < 1.0])
    before_m = receiver.method.course.settings.height_m

    def with_changed(one):
        page = site_page_for(changed, beacon_of(one).sequence, one.anchor)
        return with_beacon(one, almanac_issue=site_issue(changed), page=page)

    later = [with_changed(one) for one in free_tape() if one.host_s >= 1.0]
    assert len(fixes_of(receiver, later)) > 100
    assert receiver.almanac.issue == site_issue(changed)
    assert receiver.method.course.settings.height_m == 0.2 != before_m


def assert_goes_on(before, rest):
    whole = Receiver()
    fixes_of(whole, before)
    again = whole.copied()
    assert fixes_of(again, rest) == fixes_of(whole, rest)
    assert again.counters == whole.counters


def test_a_copy_goes_on_with_the_same_bits():
    """Also after a change of the period, where anchors are silent for longer than the method allows."""
    for cut in (3, 12, 40, 400):
        assert_goes_on(free_tape()[:cut], free_tape()[cut : cut + 60])
    slower = period_code(1.0)
    changed = [with_beacon(one, period_code=slower) if one.host_s > 1.0 else one for one in free_tape(seconds=4.0)]
    cut = next(k for k, one in enumerate(changed) if one.host_s > 1.5)
    silent = {anchor.id for anchor in FREE.anchors[:2]}
    assert_goes_on(changed[:cut], [one for one in changed[cut:] if one.anchor not in silent or one.host_s > 2.8])


def test_relays_of_a_weak_first_path_are_not_used():
    def with_late_relays(one):
        late = tuple(Relay(r.anchor, r.sequence, wrap(r.rx_ticks + 60)) for r in beacon_of(one).heard)
        return with_beacon(one, weak=(1 << len(late)) - 1, heard=late)

    receiver = Receiver()
    fixes_of(receiver, [with_late_relays(one) if one.host_s > 1.0 else one for one in free_tape()])
    assert receiver.method.estimator.state.status.relays_rejected < 20


@pytest.mark.parametrize("pause_s", [0.0, 1.5])
def test_a_tag_comes_to_anchors_that_none_of_its_own_has_received(pause_s):
    """Through a steel door, or out of a lift: both groups have the same site, and none relays the other's beacons."""
    others = replace(FREE, anchors=tuple(replace(anchor, id=anchor.id + 100) for anchor in FREE.anchors))
    first, then = free_tape(), free_tape(others, seed=2, seconds=4.0 + pause_s)
    zero = wrap(first[0].rx_ticks - from_seconds(first[0].host_s) - then[0].rx_ticks + from_seconds(then[0].host_s))
    moved = [replace(one, rx_ticks=wrap(one.rx_ticks + zero)) for one in then if one.host_s > 2.0 + pause_s]
    receiver, latest_s = Receiver(), []
    for one in (*first, *moved):
        fix = receiver.hear(one.reception)
        if fix is not None:
            latest_s.append(one.host_s)
            assert_honest(fix, one.truth_m)
    seconds = np.array(latest_s)
    assert np.min(seconds[seconds > 2.0]) < 2.0 + max(1.0, pause_s) + 0.2
    assert np.count_nonzero(seconds > 3.2 + pause_s) > 200


def test_one_radio_of_many_names_that_measures_truly_changes_no_page():
    """Twelve names that relay true receptions of anchors in use: they join, but are no majority."""
    heard, tag = free_tape(), free_tape()[0]
    pages = [replace(page, tag_height_m=17.0) if isinstance(page, SitePage) else page for page in site_pages_of(FREE)]

    def name(n, tx_ticks):
        now = from_seconds(0.5 + (n + 0.37) / 60.0)
        newest = {one.anchor: one for one in heard if one.host_s < 0.499 + (n + 0.37) / 60.0}
        relays = tuple(
            Relay(
                one.anchor,
                beacon_of(one).sequence,
                wrap(tx_ticks - wrap(tag.rx_ticks + now - from_seconds(tag.host_s) - one.rx_ticks)),
            )
            for one in sorted(newest.values(), key=lambda one: -one.host_s)[:3]
        )
        return a_beacon(
            anchor=1000 + n % 12, sequence=n // 12, tx_ticks=tx_ticks, heard=relays, almanac_issue=site_issue(pages),
            page=pages[(n + n // 12) % len(pages)], position=StatedPosition(500.0, 500.0, 2.0),
        )  # fmt: skip

    receiver = Receiver()
    made = fixes_of(receiver, merged(heard, false_frames(60.0, name, first_s=0.5)))
    assert 1000 in receiver.method.estimator.anchors
    assert receiver.almanac.issue == site_issue(site_pages_of(FREE))
    assert len(made) > 550
