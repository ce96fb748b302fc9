from hypothesis import given
from hypothesis import strategies as st

from skyless.air.site_choice import MOST_SITES, SITE_SILENCE_TICKS, SiteChoice, SiteKey, SiteUse
from skyless.ticks import from_seconds

HOME, OTHER = SiteKey(1, 2), SiteKey(77, 2)
STEP = from_seconds(0.01)


def received(choice, *rows, start=0):
    """What each beacon of (site, anchor) is, one every 10 ms."""
    return [choice.on_beacon(key, anchor, start + number * STEP) for number, (key, anchor) in enumerate(rows)]


def test_the_first_site_is_used():
    assert received(SiteChoice(), (HOME, 1), (HOME, 2)) == [SiteUse.CHANGED, SiteUse.USED]


def test_until_there_are_fixes_the_site_with_more_anchors_is_used():
    choice = SiteChoice()
    uses = received(choice, (OTHER, 9), (OTHER, 9), (HOME, 1), (HOME, 1), (HOME, 2), (OTHER, 9))
    assert uses == [
        SiteUse.CHANGED, SiteUse.USED, SiteUse.FOREIGN, SiteUse.FOREIGN, SiteUse.CHANGED, SiteUse.FOREIGN,
    ]  # fmt: skip
    assert choice.key == HOME


def test_a_site_with_fixes_stays_until_it_is_silent():
    choice = SiteChoice()
    received(choice, (HOME, 1))
    choice.fix_ticks = choice.heard_ticks = 0
    assert set(received(choice, *((OTHER, anchor) for anchor in range(20)), start=STEP)) == {SiteUse.FOREIGN}
    assert choice.on_beacon(OTHER, 1, SITE_SILENCE_TICKS) is SiteUse.CHANGED


def test_a_site_that_gives_no_fixes_any_more_is_left_for_one_with_more_anchors():
    choice = SiteChoice()
    received(choice, (HOME, 1))
    choice.fix_ticks = 0
    late = SITE_SILENCE_TICKS + STEP
    choice.heard_ticks = late
    assert received(choice, (HOME, 1), (OTHER, 1), (OTHER, 2), start=late)[-1] is SiteUse.CHANGED


def test_another_version_is_another_site():
    assert received(SiteChoice(), (HOME, 1), (SiteKey(1, 1), 1))[-1] is SiteUse.FOREIGN


def test_only_the_configured_site_is_used():
    choice = SiteChoice(77)
    assert received(choice, (HOME, 1), (HOME, 2), (OTHER, 1)) == [SiteUse.FOREIGN, SiteUse.FOREIGN, SiteUse.CHANGED]


@given(st.lists(st.tuples(st.integers(0, 200), st.integers(0, 300)), max_size=400))
def test_memory_is_bounded_and_the_site_in_use_is_kept(rows):
    choice = SiteChoice()
    received(choice, *((SiteKey(site, 2), anchor) for site, anchor in rows))
    assert len(choice.anchors) <= MOST_SITES
    assert all(len(anchors) <= 32 for anchors in choice.anchors.values())
    if rows:
        assert choice.key is not None
        assert choice.key.site << 8 | 2 in choice.anchors
