"""What a tag receives by the planner, against closed forms and a plain loop; and the plan's warnings."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.core.air.frame import MAX_FRAME_BYTES, air_time_s
from skyless.core.any_anchor import beacon_period_s
from skyless.core.geometry import RADIO_REACH_M
from skyless.core.site import AnchorSite, ScheduleSite, Site, TagsSite, WallSite
from skyless.sim.impairments import Impairments
from skyless.sim.tape import Tape
from skyless.sim.trajectory import Static
from skyless.site.channel import ChannelModel, received_power_dbm
from skyless.site.file.template import grid_site
from skyless.site.planning.links import floor_of, range_of, with_range
from skyless.site.planning.picture import draw_rates
from skyless.site.planning.rates import RECEIVED_HZ, rate_map, rate_report, tag_rates

pytestmark = pytest.mark.statistical

SHARP = ChannelModel(sensitivity_width_db=1e-3)
RATE_HZ = 100.0
LEFT_OVER = math.exp(-2.0 * air_time_s(MAX_FRAME_BYTES) * RATE_HZ)
"""Share of the frames that one rival leaves."""


def two_anchors(apart_m, **more):
    anchors = (AnchorSite(1, 0.0, 0.0), AnchorSite(2, apart_m, 0.0))
    schedule = ScheduleSite(mode="free", rate_hz=RATE_HZ)
    return Site("two", 1, 1, anchors, schedule, tags=TagsSite(height_m=0.0), **more)


def along(*x_m):
    return np.array([(x, 0.0, 0.0) for x in x_m])


def beacons(site, points, **more):
    """Beacons received over those that one anchor sends."""
    return tag_rates(site, points, SHARP, **more).beacons_per_s / RATE_HZ


def test_the_range_that_a_site_assumes_is_the_planners():
    assert round(range_of(ChannelModel())) == pytest.approx(RADIO_REACH_M, abs=1.0)


def test_a_frame_has_no_rival_if_other_senders_are_far_enough():
    """10 dB of capture and exponent 2: by the square root of ten as far as its own sender."""
    survives_to_m = 60.0 / (1.0 + math.sqrt(10.0))
    points = along(survives_to_m - 0.1, survives_to_m + 0.1, 30.0, 60.0 - survives_to_m + 0.1)
    assert beacons(two_anchors(60.0), points) == pytest.approx([1.0, LEFT_OVER, 2.0 * LEFT_OVER, 1.0], abs=1e-3)


def test_the_exponent_shortens_the_range_and_spares_from_others():
    reach_m = range_of(SHARP, 2.5)
    assert reach_m == pytest.approx(range_of(SHARP) ** 0.8)
    reached = beacons(two_anchors(500.0), along(reach_m - 0.05, reach_m + 0.05), exponent=2.5)
    assert reached == pytest.approx([1.0, 0.0], abs=1e-3)
    assert range_of(with_range(SHARP, 20.0, 3.0), 3.0) == pytest.approx(20.0)
    survives_to_m = 20.0 / (1.0 + 10.0**0.4)
    points = along(survives_to_m - 0.05, survives_to_m + 0.05)
    shared = beacons(two_anchors(20.0), points, exponent=2.5)
    assert shared == pytest.approx([1.0 + LEFT_OVER, 2.0 * LEFT_OVER], abs=1e-3)


def test_walls_weaken_frames_and_keep_others_out():
    wall = (WallSite(15.0, -5.0, 15.0, 5.0, loss_db=20.0),)
    assert beacons(two_anchors(30.0, walls=wall), along(14.0, 16.0)) == pytest.approx([1.0, 1.0], abs=1e-3)
    assert beacons(two_anchors(30.0), along(14.0, 16.0)) == pytest.approx([2.0 * LEFT_OVER] * 2, abs=1e-3)
    assert beacons(two_anchors(40.0, walls=wall), along(16.0)) == pytest.approx([1.0], abs=1e-3)


def test_against_a_plain_loop():
    site = grid_site(240.0, 200.0, 13.0, 4.0, 1.2)
    points = np.random.default_rng(5).uniform((0.0, 0.0, 0.0), (240.0, 200.0, 3.0), (40, 3))
    rates = tag_rates(site, points, ChannelModel(), 2.2)
    rate_hz = 1.0 / beacon_period_s(site)
    for k, point in enumerate(points):
        apart_m = [math.dist(point, (a.x_m, a.y_m, a.z_m)) for a in site.anchors]
        power = [received_power_dbm(-14.3, d, 2.0 * math.log10(max(d, 1.0))) for d in apart_m]
        each = []
        for own in power:
            rivals = sum(own - other < 10.0 for other in power) - 1
            alone = 1.0 / (1.0 + math.exp((-93.0 - own) / 0.5))
            each.append(alone * math.exp(-2.0 * air_time_s(MAX_FRAME_BYTES) * rate_hz * rivals) * rate_hz)
        assert rates.beacons_per_s[k] == pytest.approx(sum(each), rel=1e-4)
        assert rates.received[k] == sum(hz >= RECEIVED_HZ for hz in each)


@pytest.mark.statistical
def test_rates_of_a_simulated_site():
    """Tags at rest for a second: 16 times about 155 beacons, so 2 % of chance.

    Anchors' beacons are spaced more evenly than at random.
    """
    site = grid_site(300.0, 300.0, 15.0, 4.0, 1.2)
    points = np.random.default_rng(4).uniform((60.0, 60.0, 1.2), (240.0, 240.0, 1.2), (16, 3))
    tags = [Static(*point) for point in points.tolist()]
    tape = Tape(site, tags, Impairments(), 7)
    simulated = np.mean([len(tape.hear(tag, 2.0, 3.0)) for tag in range(len(tags))])
    assert simulated == pytest.approx(np.mean(tag_rates(site, points, ChannelModel()).beacons_per_s), rel=0.06)


def test_random_instants_give_what_theory_says():
    """Many anchors in reach: 1/(20 τ) beacons a second, whatever their density."""
    site = grid_site(500.0, 400.0, 7.0, 1.2, 1.2)
    points = np.random.default_rng(1).uniform((150.0, 130.0, 1.2), (350.0, 270.0, 1.2), (300, 3))
    found = np.mean(tag_rates(site, points, ChannelModel()).beacons_per_s)
    assert found == pytest.approx(0.95 / (20.0 * air_time_s(MAX_FRAME_BYTES)), rel=0.05)


def planned(site, tmp_path, exponent=2.0):
    floor = floor_of(site, tmp_path / "x.toml", None, None)
    mapped = rate_map(site, floor, (1.2,), None, ChannelModel(), exponent)
    return floor, mapped, rate_report(site, floor, mapped, ChannelModel(), exponent)["warnings"]


def test_warnings_say_what_to_change(tmp_path):
    site = grid_site(300.0, 200.0, 15.0, 4.0, 1.2)
    _, mapped, warnings = planned(site, tmp_path)
    assert warnings == []
    assert mapped.reception.anchors_in_reach.worst_5_percent >= 8
    (warning,) = planned(site, tmp_path, exponent=2.5)[2]
    assert "only 2 anchors are in reach (16 m" in warning
    assert "hang anchors at 53 % of their distances" in warning
    crowded = replace(site, schedule=replace(site.schedule, rate_hz=200.0))
    assert "another schedule.rate_hz than 200" in planned(crowded, tmp_path)[2][-1]


@pytest.mark.parametrize(("side_m", "spacing_m", "labels"), [((60.0, 36.0), 12.0, 15), ((120.0, 48.0), 4.0, 0)])
def test_the_picture_has_identifiers_while_there_is_space(tmp_path, side_m, spacing_m, labels):
    site = grid_site(*side_m, spacing_m, 4.0, 1.2)
    floor, mapped, _ = planned(site, tmp_path)
    axes, *_ = draw_rates(site, floor, mapped, tmp_path / "x.toml", "text").axes
    assert sorted(int(text.get_text()) for text in axes.texts) == list(range(1, labels + 1))
    assert len(axes.images) == 1
