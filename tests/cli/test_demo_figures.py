"""Figures of a demo: fixes beside the truth, rates, latencies, what was too old, and alerts."""

import time

import msgspec
import pytest
from node_stage import FakeLink

from skyless.cli.nodes.demo import DemoFigures, sentence
from skyless.cli.nodes.site_view import SiteView
from skyless.run.mqtt.messages import Counters, FixMessage, TagHealth, TrueMotion, TruthMessage

NOW_S = time.time()
UNIT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def fix(tag="t1", serial=1, unix_s=NOW_S, position_m=(1.0, 2.0, 0.0), std_m=0.1, height_known=True, latency_s=1e-3):
    return FixMessage(
        tag, serial, unix_s, 0.0, position_m, UNIT, None, None, std_m, None, None, None, None, (1, 2), 0.0, 2, 0.0,
        "joint", height_known, latency_s,
    )  # fmt: skip


def truth(unix_s, position_m, velocity_mps=(0.0, 0.0, 0.0), tag="t1"):
    return TruthMessage(unix_s, {tag: TrueMotion(position_m, velocity_mps)})


def health(unix_s, fixes, tag="t1"):
    return TagHealth(
        tag, unix_s, 1.0, "joint", fixes, fixes, 0.0, None, 0.1, None, None, {}, Counters(0, 0, 0), 0.1, 1, ()
    )


@pytest.fixture
def site():
    link, figures = FakeLink(), DemoFigures(planar=True)
    figures.follow(SiteView(link, 7))
    return link, figures


def test_a_fix_is_judged_beside_the_truth_at_its_own_time(site):
    link, watch = site
    link.receive("truth", truth(NOW_S, (1.0, 2.0, 0.0), (1.0, 0.0, 0.0)))
    link.receive("/fix", fix(unix_s=NOW_S + 0.04, position_m=(1.04, 2.03, 5.0)))
    assert watch.tags["t1"].error_m == pytest.approx(0.03)  # a known height does not count
    link.receive("/fix", fix(unix_s=NOW_S + 0.04, position_m=(1.04, 2.0, 0.05), height_known=False))
    assert watch.tags["t1"].error_m == pytest.approx(0.05)


def test_no_truth_no_error(site):
    link, watch = site
    link.receive("/fix", fix())
    assert watch.tags["t1"].error_m is None
    link.receive("truth", truth(NOW_S, (1.0, 2.0, 0.0)))
    link.receive("/fix", fix(unix_s=NOW_S + 0.5))  # it is too old
    assert watch.tags["t1"].error_m is None
    link.receive("truth", truth(NOW_S + 0.6, (1.0, 2.0, 0.0), tag="another"))
    link.receive("/fix", fix(unix_s=NOW_S + 0.6))
    assert watch.tags["t1"].error_m is None
    assert watch.judged == 0


def test_a_truth_from_before_a_restart_of_the_ether_is_forgotten(site):
    link, watch = site
    link.receive("truth", truth(NOW_S + 100.0, (9.0, 9.0, 0.0)))
    link.receive("truth", truth(NOW_S, (1.0, 2.0, 0.0)))
    link.receive("/fix", fix(unix_s=NOW_S))
    assert watch.tags["t1"].error_m == pytest.approx(0.0)
    link.receive("/fix", fix(unix_s=NOW_S + 100.0))
    assert watch.tags["t1"].error_m is None


def test_errors_count_from_a_second_after_a_tag_s_first_fix(site):
    link, watch = site
    for number in range(30):
        link.receive("truth", truth(NOW_S + number * 0.1, (1.0, 2.0, 0.0)))
        off_m = 1.0 if number < 10 else 0.03
        link.receive("/fix", fix(serial=number, unix_s=NOW_S + number * 0.1, position_m=(1.0 + off_m, 2.0, 0.0)))
    found = watch.errors.summary()
    assert watch.judged == 20
    assert found.rmse_2d_m == pytest.approx(0.03)
    assert (watch.variance_sum_m2 / watch.judged) ** 0.5 == pytest.approx(0.1)


def test_the_rate_counts_between_health_messages_and_again_after_a_tag_s_restart(site):
    link, watch = site
    link.receive("tag/+/health", health(NOW_S, 100))  # before its first fix was heard it is unknown
    assert watch.tags == {}
    link.receive("/fix", fix())
    assert watch.tags["t1"].updates_per_s is None
    for second in range(4):
        link.receive("tag/+/health", health(NOW_S + second, 100 + 400 * second))
    assert watch.tags["t1"].updates_per_s == pytest.approx(400.0)
    link.receive("tag/+/health", health(NOW_S + 10.0, 50))
    assert watch.tags["t1"].updates_per_s is None
    link.receive("tag/+/health", health(NOW_S + 11.0, 350))
    assert watch.tags["t1"].updates_per_s == pytest.approx(300.0)


def test_latencies_are_those_of_the_tag_and_those_to_here(site):
    link, watch = site
    for latency_s in (1e-3, 2e-3, 3e-3):
        link.receive("/fix", fix(unix_s=time.time() - 0.5, latency_s=latency_s))
    assert watch.latencies.drain()[0] == pytest.approx(2e-3)
    median_s, _, number = watch.arrivals.drain()
    assert number == 3
    assert 0.5 <= median_s < 5.0


def test_alerts_are_counted_and_words_that_are_none_are_not(site):
    link, watch = site
    assert watch.summary()["alerts"] == {}
    for alert in (None, "none", "detected-excluded", "none", "\x1b[2Jboo"):
        link.receive("/fix", msgspec.structs.replace(fix(), alert=alert))
    assert watch.summary()["alerts"] == {"detected-excluded": 1, "none": 2}


def test_what_was_too_old_is_named_where_there_was_any(site):
    link, watch = site
    link.receive("/fix", fix())
    for counters, late in (({"malformed": 4}, (0, 0)), ({"late-reception": 250, "late-fix": 3}, (250, 3))):
        link.receive("tag/+/health", msgspec.structs.replace(health(NOW_S, 9), counters=counters))
        found = watch.summary()
        assert (found["late_receptions"], found["late_fixes"]) == late
        words = "this computer is too slow: 250 receptions dropped and 3 fixes withheld as too old"
        assert (words in sentence(found)) == (late != (0, 0))
