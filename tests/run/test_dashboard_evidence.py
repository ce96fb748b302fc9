"""What the condition rests on: ages of fixes on arrival, and the use of processors as Linux counts it."""

import pytest

from skyless.run.condition.evidence import USE_WINDOW_S, Evidence, FixAges, ProcessorUse
from skyless.run.site_table import SiteTable
from support.site_messages import a_fix

UNIX_S = 1e9


def run(ages, begin_s, end_s, clock_s=0.0, delay_s=0.0, health=False, rate_hz=20):
    """Fixes of a tag whose clock differs by ``clock_s``, with health every second; the last least age."""
    for step in range(round(begin_s * rate_hz), round(end_s * rate_hz)):
        now_s = step / rate_hz
        if health and step % rate_hz == 0:
            ages.add_health("t1", delay_s, now_s)
        ages.add_fix("t1", UNIX_S + now_s - delay_s - 1e-3 + clock_s, 1e-3, now_s)
    return ages.least_ages_s()["t1"][0]


@pytest.mark.parametrize("health", [False, True])
def test_a_clock_that_is_set_back_is_no_delay_and_a_delay_after_it_is_one(health):
    ages = FixAges()
    assert run(ages, 0, 5, health=health) == pytest.approx(1e-3, abs=1e-6)
    assert run(ages, 5, 6, clock_s=-2.0, health=health) == pytest.approx(1e-3, abs=1e-6)
    assert run(ages, 7.5, 9, clock_s=-2.0, delay_s=1.5, health=health) >= 1e-3  # messages wait, in their order
    assert run(ages, 9, 10, clock_s=-2.0, delay_s=1.5, health=health) == pytest.approx(1.501, abs=1e-6)


def test_the_health_of_a_tag_of_this_computer_counts_more_than_the_quickest_message():
    """A clock that is set back by less than the interval of the fixes does not show by itself."""
    ages = FixAges()
    run(ages, 0, 5, health=True, rate_hz=1)
    assert run(ages, 5, 8, clock_s=-0.6, health=True, rate_hz=1) == pytest.approx(1e-3, abs=1e-6)


@pytest.mark.parametrize("clock_error_s", [0.0, 3600.0, -3600.0])
def test_the_time_of_a_fix_is_by_the_readers_clock_however_late_it_comes(clock_error_s):
    evidence = Evidence(SiteTable(0.0))
    for now_s, late_s in ((0.0, 0.0), (3.0, 2.0), (6.0, 0.0)):
        unix_s = UNIX_S + now_s
        tag = evidence.add_fix(a_fix(unix_s=unix_s - late_s + clock_error_s, latency_s=0.0), now_s, unix_s)
        assert tag.ended_unix_s == pytest.approx(unix_s - late_s, abs=1e-3)


def test_figures_of_slow_tags_are_steady_and_end_after_a_while():
    ages = FixAges()
    run(ages, 0, 5, rate_hz=1)
    for half in range(10, 28):
        median_s, p99_s = ages.percentiles_s(0.5 * half)
        assert median_s == p99_s == pytest.approx(1e-3, abs=1e-6)
    assert ages.percentiles_s(14.5) == (None, None)


def test_very_many_fixes_do_not_fill_the_memory():
    ages = FixAges()
    run(ages, 0, 10, delay_s=0.5, rate_hz=500)
    run(ages, 10, 20, delay_s=0.0, rate_hz=500)
    assert ages.percentiles_s(20.0)[1] == pytest.approx(1e-3, abs=1e-6)
    assert len(ages._recent) < 5000


def write(counters, *, busy, idle):
    user, system, wait = busy // 2, busy - busy // 2, idle // 4
    counters.write_text(f"cpu  {user} 0 {system} {idle - wait} {wait} 0 0 0 7 7\ncpu0 1 2 3\n", encoding="ascii")


def test_the_share_is_of_the_last_two_seconds(tmp_path):
    counters = tmp_path / "stat"
    use = ProcessorUse(counters)
    busy, idle, shares = 1000, 5000, []
    for step in range(17):
        write(counters, busy=busy, idle=idle)
        shares.append(use.share(0.5 * step))
        worked = 100 if step >= 8 else 40  # of the 100 ticks of two processors in half a second
        busy, idle = busy + worked, idle + 100 - worked
    assert shares[:4] == [None] * 4
    assert shares[4:9] == pytest.approx([0.4] * 5)
    assert shares[9:12] == pytest.approx([0.55, 0.7, 0.85])
    assert shares[12:] == pytest.approx([1.0] * 5)


STILL = "cpu  5 0 5 8 2 0 0 0\n"


@pytest.mark.parametrize("text", ["", "cpu 1 2\n", "cpu a b c d e f g h\n", STILL, None])
def test_a_system_that_does_not_say_gives_no_share(tmp_path, text):
    counters = tmp_path / "stat"
    if text is not None:
        counters.write_text(text, encoding="ascii")
    use = ProcessorUse(counters)
    assert [use.share(k * USE_WINDOW_S) for k in range(3)] == [None] * 3
