import itertools
import random

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.almanac import AccuracyPage, AnchorPage, GeoreferencePage, NoisePage, SchedulePage
from skyless.core.air.site_pages import decode_page, encode_page
from skyless.core.protocol1.almanac import almanac_issue, page_for, pages_of
from skyless.core.site import (
    EXACT,
    AccuracySite,
    AnchorSite,
    GeoreferenceSite,
    NoiseSite,
    ScheduleSite,
    Site,
    TagsSite,
)
from skyless.site.file.check import SITE_LIMITS


def site(anchors=7, **changes):
    nodes = tuple(AnchorSite(number, 0.1 * number, 1.0, 2.5) for number in range(1, anchors + 1))
    return Site("lab", 1, 1, nodes, **changes)


def some_pages(count):
    return tuple(AnchorPage(number, 0.0, 0.0, 0.0, 0) for number in range(count))


def receptions_until_complete(pages, receptions):
    """How many (superframe, slot) it takes until every page was heard."""
    missing = set(pages)
    for count, (superframe, slot) in enumerate(receptions, 1):
        missing.discard(page_for(pages, superframe, slot))
        if not missing:
            return count
    return None


def prime_from(count):
    return next(number for number in itertools.count(max(count, 2)) if all(number % d for d in range(2, number)))


def test_pages_of_a_site():
    earth = GeoreferenceSite(52.0, 4.0, 3.0, -90.0)
    pages = pages_of(site(2, georeference=earth, tags=TagsSite(height_m=1.2), schedule=ScheduleSite(slots=5)))
    assert pages == (
        SchedulePage(2**27, 5, 1, 1, 2, 1.2),
        NoisePage(pytest.approx(100e-12), pytest.approx(100e-12), 2e-11, 1e-9),
        AccuracyPage(0.02, 0.03, 0.05, 0.005, 1.0, 100.0),
        AnchorPage(1, 0.1, 1.0, 2.5, 0),
        AnchorPage(2, 0.2, 1.0, 2.5, 1),
        GeoreferencePage(52.0, 4.0, 3.0, 270.0),
    )
    assert len(pages_of(site(2))) == 5


@given(st.integers(1, 60), st.integers(0, 254), st.integers(0, 2**32 - 500), st.integers(1, 500))
def test_one_slot_brings_every_page_whatever_the_duty_cycle(count, slot, start, every):
    pages = some_pages(count)
    heard = ((start + every * number, slot) for number in range(2 * count + 2))
    positions = receptions_until_complete(pages, ((start + number, slot) for number in range(10 * count + 2)))
    # The rotation's length is a prime below twice the number of pages (Bertrand); 2 at least.
    assert positions <= max(2, 2 * count - 1)
    period = prime_from(count)
    if every % period:
        assert receptions_until_complete(pages, heard) <= period


@given(st.integers(1, 255), st.integers(0, 2**32 - 1))
def test_slots_of_one_superframe_bring_different_pages(count, superframe):
    pages = some_pages(count)
    carried = [page_for(pages, superframe, slot) for slot in range(count)]
    # No page twice, but for those that fill the rotation up to a prime.
    assert len(set(carried)) >= count - (prime_from(count) - count)


@pytest.mark.parametrize("anchors", range(3, 33))
@pytest.mark.parametrize(("earth", "superframes"), [(None, 3), (GeoreferenceSite(52.0, 4.0), 4)])
def test_all_anchors_heard_fill_the_almanac_in_a_few_superframes(anchors, earth, superframes):
    pages = pages_of(site(anchors, georeference=earth))
    for start in range(50):
        heard = ((start + number // anchors, number % anchors) for number in range(superframes * anchors))
        assert receptions_until_complete(pages, heard) is not None


@pytest.mark.parametrize("anchors", [4, 7, 16, 40, 200])
def test_a_few_anchors_heard_at_random_fill_it_in_due_time(anchors):
    # Each superframe another four of the slots: as if pages were drawn, n ln n receptions and some n more.
    rng = random.Random(anchors)
    pages = pages_of(site(anchors))
    heard = ((superframe, slot) for superframe in range(10_000) for slot in rng.sample(range(anchors), 4))
    assert receptions_until_complete(pages, heard) < 12 * len(pages)


@pytest.mark.parametrize("end", ["low", "high"])
def test_whatever_a_site_file_may_say_fits_the_pages(end):
    def at_end(*keys):
        return [getattr(SITE_LIMITS[key], end) for key in keys]

    places = at_end("anchors.id", "anchors.x_m", "anchors.y_m", "anchors.z_m")
    noise = at_end("noise.tx_stamp_ps", "noise.rx_stamp_ps", "noise.white_fm", "noise.random_walk_fm")
    accuracy = at_end(*(f"accuracy.{field}" for field in AccuracySite.__struct_fields__))
    earth = at_end(*(f"georeference.{field}" for field in GeoreferenceSite.__struct_fields__))
    extreme = Site(
        "lab",
        *at_end("id", "master"),
        (AnchorSite(*places, *at_end("anchors.slot")),),
        ScheduleSite(slots=255),
        NoiseSite(*noise),
        TagsSite(*at_end("tags.height_m")),
        AccuracySite(*accuracy),
        georeference=GeoreferenceSite(*earth),
    )
    for page in pages_of(extreme):
        assert type(decode_page(encode_page(page))) is type(page)


def test_accuracy_of_a_site_file_comes_back_as_it_was():
    for accuracy in (AccuracySite(), EXACT, AccuracySite(0.0153, 0.1, 0.0007, 1.2345, 0.35, 12.3)):
        (page,) = (page for page in pages_of(site(accuracy=accuracy)) if isinstance(page, AccuracyPage))
        heard = decode_page(encode_page(page))
        assert AccuracySite(**msgspec.structs.asdict(heard)) == accuracy


def test_issue_is_the_same_for_the_same_contents():
    assert almanac_issue(pages_of(site())) == almanac_issue(pages_of(site()))
    quantised = tuple(decode_page(encode_page(page)) for page in pages_of(site()))
    assert almanac_issue(quantised) == almanac_issue(pages_of(site()))
    assert 0 <= almanac_issue(pages_of(site())) <= 255


def test_issue_depends_on_every_page():
    pages = pages_of(site(anchors=9))
    issue = almanac_issue(pages)
    for at, page in enumerate(pages):
        moved = msgspec.structs.replace(page, **changed_field(page))
        assert almanac_issue((*pages[:at], moved, *pages[at + 1 :])) != issue
    assert almanac_issue(pages[::-1]) != issue


def changed_field(page):
    match page:
        case AnchorPage():
            return {"z_m": page.z_m + 0.001}
        case SchedulePage():
            return {"slots": page.slots + 1}
        case AccuracyPage():
            return {"survey_std_m": page.survey_std_m + 0.001}
        case _:
            return {"white_fm": page.white_fm * 2}


def test_issue_spreads_over_all_values():
    # 2000 almanacs over 256 values: chi-squared of 255 degrees of freedom, 5 sigma.
    counts = [0] * 256
    for number in range(2000):
        counts[almanac_issue((AnchorPage(1, number / 1000, 0.0, 0.0, 0),))] += 1
    chi_squared = sum((count - 2000 / 256) ** 2 / (2000 / 256) for count in counts)
    assert chi_squared < 255 + 5 * (2 * 255) ** 0.5
