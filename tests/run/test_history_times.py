"""Times as people type them."""

import time
from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.errors import SkylessError
from skyless.run.history.answers import Span, span_of

ZONE = ZoneInfo("Europe/Berlin")
NOW = datetime(2026, 11, 26, 15, 30, 10, tzinfo=ZONE)


@pytest.fixture(autouse=True)
def berlin(monkeypatch):
    monkeypatch.setenv("TZ", "Europe/Berlin")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


def at(*parts):
    return datetime(*parts, tzinfo=ZONE).timestamp()


@pytest.mark.parametrize(
    ("text", "unix_s"),
    [
        ("today", at(2026, 11, 26)),
        ("yesterday", at(2026, 11, 25)),
        ("14:00", at(2026, 11, 26, 14)),
        ("14:00:05", at(2026, 11, 26, 14, 0, 5)),
        ("2pm", at(2026, 11, 26, 14)),
        ("today 8:00", at(2026, 11, 26, 8)),
        ("  yesterday   8:00 ", at(2026, 11, 25, 8)),
        ("yesterday at 8", at(2026, 11, 25, 8)),
        ("2 hours ago", at(2026, 11, 26, 13, 30, 10)),
        ("3 days ago", at(2026, 11, 23)),
        ("1 week ago", at(2026, 11, 19)),
        ("monday", at(2026, 11, 23)),
        ("2026-11-20", at(2026, 11, 20)),
        ("20261120", at(2026, 11, 20)),
        ("2026-07-20 06:30", at(2026, 7, 20, 6, 30)),
        ("2026-11-20T06:30:00Z", datetime(2026, 11, 20, 6, 30, tzinfo=UTC).timestamp()),
        ("2026-11-20T06:30-05:00", datetime(2026, 11, 20, 11, 30, tzinfo=UTC).timestamp()),
        ("20 Nov 2026", at(2026, 11, 20)),
        ("1790000000.5", 1790000000.5),
        ("0", 0.0),
    ],
)
def test_what_people_type(text, unix_s):
    assert span_of(text, None, NOW.timestamp()) == Span(unix_s, NOW.timestamp())


def test_a_time_of_day_is_that_of_the_day_on_which_the_range_begins():
    assert span_of("yesterday 8:00", "16:00", NOW.timestamp()) == Span(at(2026, 11, 25, 8), at(2026, 11, 25, 16))
    assert span_of("2026-11-20", "4pm", NOW.timestamp()) == Span(at(2026, 11, 20), at(2026, 11, 20, 16))
    assert span_of("8:00", "23:00", NOW.timestamp()) == Span(at(2026, 11, 26, 8), at(2026, 11, 26, 23))


@pytest.mark.parametrize(
    "text",
    ["", "nonsense", "12:61", "25:00", "8", "-1", "november", "2026", "nan", "inf", "1e300", "1790000000000",
     "2026-02-30", "x" * 500, "0001-01-01", "this week", "'; DROP TABLE fixes"],
)  # fmt: skip
def test_what_is_no_time_is_named(text):
    for given_ in ((text, None), ("today", text)):
        with pytest.raises(SkylessError, match=r"^(from|to) is .*; it should be a time such as 14:00") as error:
            span_of(*given_, NOW.timestamp())
        assert len(str(error.value)) < 250


@pytest.mark.parametrize(
    ("begin", "end", "error"),
    [
        ("16:00", None, "from is '16:00', which is in the future"),
        ("tomorrow", "2099-01-01", "from is 'tomorrow', which is in the future"),
        ("14:00", "13:00", r"to is '13:00' \(2026-11-26 13:00:00\); it should be later than from"),
        ("yesterday", "yesterday", "should be later than from"),
        ("now", None, "to is now"),
    ],
)
def test_a_range_lies_in_the_past_and_has_a_length(begin, end, error):
    with pytest.raises(SkylessError, match=error):
        span_of(begin, end, NOW.timestamp())


@given(st.datetimes(datetime(1980, 1, 1), datetime(2026, 11, 25)), st.integers(1, 10**6))
def test_iso_times_of_any_zone(when, seconds):
    begin = when.replace(microsecond=0, tzinfo=UTC)
    end = begin + timedelta(seconds=seconds)
    found = span_of(begin.isoformat(), end.astimezone(ZONE).isoformat(), NOW.timestamp())
    assert found == Span(begin.timestamp(), end.timestamp())


@given(st.text(max_size=30))
def test_any_text_is_a_time_or_a_clear_error(text):
    try:
        span = span_of(text, None, NOW.timestamp())
    except SkylessError:
        return
    assert 0.0 <= span.from_unix_s < span.to_unix_s
