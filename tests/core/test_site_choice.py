from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.site_choice import (
    CHANGED,
    FOREIGN,
    NO_SITE,
    SITE_SILENCE_TICKS,
    TRIAL_TICKS,
    USED,
    SiteChoice,
    choose_site,
    note_fix,
)
from skyless.core.native.records import MAX_COUNTED, MAX_SITES
from skyless.core.ticks import from_seconds

HOME, OTHER = 1, 77
STEP = from_seconds(0.01)


def received(choice, *rows, start=0):
    """What each beacon of (site, anchor) is, one every 10 ms."""
    return [choose_site(choice, key, anchor, start + number * STEP) for number, (key, anchor) in enumerate(rows)]


def test_until_there_are_fixes_the_site_with_more_anchors_is_used():
    choice = SiteChoice()
    uses = received(choice, (OTHER, 9), (OTHER, 9), (HOME, 1), (HOME, 1), (HOME, 2), (OTHER, 9))
    assert uses == [
        CHANGED, USED, FOREIGN, FOREIGN, CHANGED, FOREIGN,
    ]  # fmt: skip
    assert choice.site == HOME


def test_a_site_with_fixes_stays_until_it_is_silent():
    choice = SiteChoice()
    received(choice, (HOME, 1))
    note_fix(choice, 0)
    choice.heard_ticks = 0
    assert set(received(choice, *((OTHER, anchor) for anchor in range(20)), start=STEP)) == {FOREIGN}
    assert choose_site(choice, OTHER, 1, SITE_SILENCE_TICKS) == CHANGED


def test_a_site_that_gives_no_fixes_any_more_is_left_for_one_with_more_anchors():
    choice = SiteChoice()
    received(choice, (HOME, 1))
    note_fix(choice, 0)
    late = SITE_SILENCE_TICKS + STEP
    choice.heard_ticks = late
    assert received(choice, (HOME, 1), (OTHER, 1), (OTHER, 2), start=late)[-1] == CHANGED


def test_only_the_configured_site_is_used():
    choice = SiteChoice(only_site=77)
    assert received(choice, (HOME, 1), (HOME, 2), (OTHER, 1)) == [FOREIGN, FOREIGN, CHANGED]


@given(st.lists(st.tuples(st.integers(0, 200), st.integers(0, 300)), max_size=400))
def test_memory_is_bounded_and_the_site_in_use_is_kept(rows):
    choice = SiteChoice()
    received(choice, *rows)
    sites = choice.sites[: choice.count]
    assert choice.count <= MAX_SITES
    for one in sites:
        anchors = [counted.anchor for counted in one.anchors[: one.count]]
        assert len(set(anchors)) == one.count <= MAX_COUNTED
    assert len({one.site for one in sites}) == choice.count
    assert choice.site in ({one.site for one in sites} if rows else {NO_SITE})


def sites_used(choice, rows, start=0):
    """The site in use at each beacon of (site, anchor), one every 10 ms, all of which are accepted."""
    used = []
    for number, (key, anchor) in enumerate(rows):
        if choose_site(choice, key, anchor, start + number * STEP) != FOREIGN:
            choice.heard_ticks = start + number * STEP
        used.append(choice.site)
    return used


def test_a_site_that_gives_no_fix_makes_way_and_does_not_return_by_its_number_of_anchors():
    """Eight foreign anchors from the start, three of the own site: these give fixes, once they are used."""
    choice, trial = SiteChoice(), round(TRIAL_TICKS / STEP)
    rows = [row for n in range(trial) for row in ((OTHER, n % 8), (HOME, n % 3))]
    used = sites_used(choice, rows)
    assert set(used[20 : trial - 1]) == {OTHER}
    assert set(used[trial + 1 : 2 * trial - 1]) == {HOME}
    note_fix(choice, 2 * trial * STEP)
    assert set(sites_used(choice, rows[: trial // 5], start=2 * trial * STEP)) == {HOME}


def test_a_site_that_failed_is_tried_again_after_the_other_one_has_failed():
    trial = round(TRIAL_TICKS / STEP)
    used = sites_used(SiteChoice(), [((HOME, OTHER)[n % 2], n % 8) for n in range(round(2.5 * trial))])
    assert [used[number * trial // 4] for number in (2, 6, 9)] == [HOME, OTHER, HOME]


def test_a_site_of_two_anchors_is_not_tried():
    rows = [row for n in range(600) for row in ((OTHER, n % 8), (HOME, n % 2))]
    assert set(sites_used(SiteChoice(), rows)[20:]) == {OTHER}
