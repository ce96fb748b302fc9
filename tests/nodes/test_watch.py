"""Watches a site: fixes beside the truth, rates, latencies, and messages that make no sense."""

import time

import pytest
from node_stage import FakeLink

from skyless.cli.watch import Watch
from skyless.run.mqtt.messages import Counters, EtherHealth, FixMessage, TagHealth, TrueMotion, TruthMessage

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
    link = FakeLink()
    return link, Watch(link, 7, planar=True)


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


@pytest.mark.parametrize("wrong", [b"{}", b"[1]", b"\xff\xfe", b'{"tag": 5}', b"9" * 5000])
def test_what_makes_no_sense_is_counted_and_nothing_else(site, wrong):
    link, watch = site
    for end in ("/fix", "truth", "tag/+/health", "anchor/+/health", "ether/+/health"):
        link.receive(end, wrong)
    assert watch.wrong == 5
    assert (watch.tags, watch.anchors, watch.ether) == ({}, {}, None)
    link.receive("ether/+/health", EtherHealth(NOW_S, 1.0, 5, 0, {}, {}, 0, 0))
    assert watch.ether.transmissions == 5
