"""What a tag receives by the planner, against closed forms and a plain loop; and the plan's warnings."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.air.codec import MAX_FRAME_BYTES
from skyless.air.ieee802154 import air_time_s
from skyless.planning.floor import floor_of
from skyless.planning.links import range_of, with_range
from skyless.planning.slot_picture import draw_slots, slot_colour
from skyless.planning.slot_plan import nearest_sharing_m, rate_map, slot_warnings
from skyless.planning.tag_rates import RECEIVED_HZ, tag_rates
from skyless.simulation.cells.timetable import FreeSchedule, SlotSchedule
from skyless.simulation.cells.world import CellWorld, anchors_of
from skyless.simulation.channel import ChannelModel, received_power_dbm
from skyless.simulation.impairments import Impairments
from skyless.simulation.trajectory import Static
from skyless.site.advice import RADIO_REACH_M
from skyless.site.grid import grid_site
from skyless.site.model import AnchorSite, ScheduleSite, Site, TagsSite, WallSite
from skyless.site.slot_colours import with_slots
from skyless.site.slots import schedule_of

SHARP = ChannelModel(sensitivity_width_db=1e-3)


def two_anchors(apart_m, same_slot=True, **more):
    anchors = (AnchorSite(1, 0.0, 0.0, slot=0), AnchorSite(2, apart_m, 0.0, slot=0 if same_slot else 1))
    schedule = ScheduleSite(mode="slots", slots=2, slot_s=1e-3, reuse_m=1.0)
    return Site("two", 1, 1, anchors, schedule, tags=TagsSite(height_m=0.0), **more)


def along(*x_m):
    return np.array([(x, 0.0, 0.0) for x in x_m])


def beacons(site, points, **more):
    rates = tag_rates(site, points, SHARP, **more)
    return (rates.beacons_per_s * site.schedule.slots * site.schedule.slot_s).round(3).tolist()


def test_the_range_that_a_site_assumes_is_the_planners():
    assert round(range_of(ChannelModel())) == pytest.approx(RADIO_REACH_M, abs=1.0)


def test_a_frame_survives_if_senders_of_its_slot_are_far_enough():
    """10 dB of capture and exponent 2: by the square root of ten as far as its own sender."""
    ratio = math.sqrt(10.0)
    survives_to_m = 60.0 / (1.0 + ratio)
    points = along(survives_to_m - 0.1, survives_to_m + 0.1, 30.0, 60.0 - survives_to_m + 0.1)
    assert beacons(two_anchors(60.0), points) == [1.0, 0.0, 0.0, 1.0]
    assert beacons(two_anchors(60.0, same_slot=False), points) == [1.0, 1.0, 2.0, 1.0]


def test_the_exponent_shortens_the_range_and_spares_from_others():
    reach_m = range_of(SHARP, 2.5)
    assert reach_m == pytest.approx(range_of(SHARP) ** 0.8)
    assert beacons(two_anchors(500.0), along(reach_m - 0.05, reach_m + 0.05), exponent=2.5) == [1.0, 0.0]
    assert range_of(with_range(SHARP, 20.0, 3.0), 3.0) == pytest.approx(20.0)
    survives_to_m = 20.0 / (1.0 + 10.0**0.4)
    assert beacons(two_anchors(20.0), along(survives_to_m - 0.05, survives_to_m + 0.05), exponent=2.5) == [1.0, 0.0]


def test_walls_weaken_frames_and_keep_others_out():
    wall = (WallSite(15.0, -5.0, 15.0, 5.0, loss_db=20.0),)
    assert beacons(two_anchors(30.0, walls=wall), along(14.0, 16.0)) == [1.0, 1.0]
    assert beacons(two_anchors(30.0), along(14.0, 16.0)) == [0.0, 0.0]
    assert beacons(two_anchors(40.0, same_slot=False, walls=wall), along(16.0)) == [1.0]


@pytest.mark.parametrize("mode", ["slots", "free"])
def test_against_a_plain_loop(mode):
    site = grid_site(240.0, 200.0, 13.0, 4.0, 1.2, mode)
    points = np.random.default_rng(5).uniform((0.0, 0.0, 0.0), (240.0, 200.0, 3.0), (40, 3))
    rates = tag_rates(site, points, ChannelModel(), 2.2)
    period_s = site.schedule.slots * site.schedule.slot_s if mode == "slots" else 1.0 / site.schedule.rate_hz
    for k, point in enumerate(points):
        each = []
        power = []
        for a in site.anchors:
            d = math.dist(point, (a.x_m, a.y_m, a.z_m))
            power.append(received_power_dbm(-14.3, d, 2.0 * math.log10(max(d, 1.0))))
        for own, a in zip(power, site.anchors, strict=True):
            rivals = [
                b for p, b in zip(power, site.anchors, strict=True) if b is not a and own - p < 10.0
                and (mode == "free" or b.slot == a.slot)
            ]  # fmt: skip
            alone = 1.0 / (1.0 + math.exp((-93.0 - own) / 0.5))
            busy = 2.0 * air_time_s(MAX_FRAME_BYTES) / period_s * len(rivals)
            each.append(alone * (math.exp(-busy) if mode == "free" else not rivals) / period_s)
        assert rates.beacons_per_s[k] == pytest.approx(sum(each), rel=1e-4)
        assert rates.received[k] == sum(hz >= RECEIVED_HZ for hz in each)


@pytest.mark.parametrize(
    ("spacing_m", "reuse_m", "median_hz", "worst_hz"),
    [(15.0, 62.0, 167, 125), (15.0, 78.0, 194, 139), (15.0, 93.0, 188, 146), (15.0, 124.0, 160, 136)],
)
def test_rates_of_a_simulated_hall(spacing_m, reuse_m, median_hz, worst_hz):
    """A simulation of 10⁴ anchors by other code found these rates, with anchors a little off the grid."""
    site = grid_site(900.0, 600.0, spacing_m, 4.0, 1.2, "free")
    schedule = ScheduleSite(mode="slots", slot_s=1e-3, reuse_m=reuse_m)
    site = with_slots(replace(site, schedule=schedule))
    points = np.random.default_rng(1).uniform((100.0, 100.0, 1.2), (800.0, 500.0, 1.2), (1500, 3))
    found = tag_rates(site, points, ChannelModel()).beacons_per_s
    assert np.median(found) == pytest.approx(median_hz, rel=0.1)
    assert np.percentile(found, 5) == pytest.approx(worst_hz, rel=0.15)


@pytest.mark.parametrize(("mode", "tolerance"), [("slots", 0.01), ("free", 0.06)])
def test_rates_of_the_simulated_cells(mode, tolerance):
    """Tags at rest for a second. Slots: only frames at the sensitivity are left to chance.

    Random instants: 16 times about 155 beacons, so 2 % of chance, and anchors whose beacons are spaced more evenly than
    at random.
    """
    site = grid_site(300.0, 300.0, 15.0, 4.0, 1.2, mode)
    points = np.random.default_rng(4).uniform((60.0, 60.0, 1.2), (240.0, 240.0, 1.2), (16, 3))
    if mode == "free":
        schedule = FreeSchedule(site.schedule.rate_hz)
    else:
        own = schedule_of(site)
        schedule = SlotSchedule(np.array([anchor.slot for anchor in site.anchors]), own.slots, own.slot_ticks)
    tags = [Static(*point) for point in points.tolist()]
    world = CellWorld(anchors_of(site), schedule, tags, Impairments(), 7)
    simulated = np.mean([len(world.receptions(tag, 2.0, 3.0)) for tag in range(len(tags))])
    assert simulated == pytest.approx(np.mean(tag_rates(site, points, ChannelModel()).beacons_per_s), rel=tolerance)


def test_random_instants_give_what_theory_says():
    """Many anchors in reach: 1/(20 τ) beacons a second, whatever their density."""
    site = grid_site(500.0, 400.0, 7.0, 1.2, 1.2, "free")
    points = np.random.default_rng(1).uniform((150.0, 130.0, 1.2), (350.0, 270.0, 1.2), (300, 3))
    found = np.mean(tag_rates(site, points, ChannelModel()).beacons_per_s)
    assert found == pytest.approx(0.95 / (20.0 * air_time_s(MAX_FRAME_BYTES)), rel=0.05)


def planned(site, tmp_path, exponent=2.0):
    floor = floor_of(site, tmp_path / "x.toml", None, None)
    mapped = rate_map(site, floor, (1.2,), None, ChannelModel(), exponent)
    return floor, mapped, slot_warnings(site, mapped, ChannelModel(), exponent)


def test_warnings_say_what_to_change(tmp_path):
    site = grid_site(300.0, 200.0, 15.0, 4.0, 1.2)
    _, mapped, warnings = planned(site, tmp_path)
    assert warnings == []
    assert mapped.reception.anchors_in_reach.worst_5_percent >= 8
    (warning,) = planned(site, tmp_path, exponent=2.5)[2]
    assert "only 2 anchors are in reach (16 m" in warning
    assert "hang anchors at 53 % of their distances" in warning
    tight = with_slots(replace(site, schedule=replace(site.schedule, reuse_m=47.0)))
    assert "a larger schedule.reuse_m than 47 m" in planned(tight, tmp_path)[2][0]
    slow = replace(site, schedule=replace(site.schedule, slot_s=2.1e-3))
    assert "mode free would give" in planned(slow, tmp_path)[2][0]


def test_nearest_anchors_of_a_slot():
    assert nearest_sharing_m(two_anchors(1.5)) == 1.5
    assert nearest_sharing_m(two_anchors(2.5)) is None
    assert nearest_sharing_m(two_anchors(1.5, same_slot=False)) is None


def test_slots_have_colours_of_their_own():
    colours = {slot_colour(slot) for slot in range(255)}
    assert len(colours) == 255
    assert all(0.0 <= part <= 1.0 for colour in colours for part in colour)


@pytest.mark.parametrize(("spacing_m", "labels"), [(12.0, 15), (3.0, 0)])
def test_the_picture_has_numbers_while_there_is_space(tmp_path, spacing_m, labels):
    site = grid_site(60.0, 36.0, spacing_m, 4.0, 1.2)
    if labels == 0:
        site = grid_site(120.0, 48.0, 4.0, 4.0, 1.2, "free")
    floor, mapped, _ = planned(site, tmp_path)
    anchors, rates, *_ = draw_slots(site, floor, mapped, tmp_path / "x.toml", "text").axes
    assert sorted(int(text.get_text()) for text in anchors.texts) == list(range(labels))
    assert len(rates.images) == 1
