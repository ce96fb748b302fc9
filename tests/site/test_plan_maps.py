"""Floors, grids, maps and their tables."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path as Polygon
from msgspec.structs import replace

from skyless.core.errors import ConfigurationError
from skyless.core.geometry import area, distance_outside, inside
from skyless.core.site import AnchorSite, GeoreferenceSite, WallSite
from skyless.sim.lab import paper_lab_site
from skyless.site.channel import ChannelModel
from skyless.site.planning import links, maps
from skyless.site.planning import maps as plan_maps

pytestmark = pytest.mark.statistical

L_SHAPE = np.array([(0, 0), (12, 0), (12, 4), (5, 4), (5, 9), (0, 9)], dtype=float)
LAB = paper_lab_site()


def lab_map(step=0.5, site=LAB):
    floor = links.floor_of(site, Path("lab.toml"), None, None)
    return plan_maps.plan_map(plan_maps.Predictor(site, ChannelModel()), plan_maps.grid_of(floor, (0.0,), step))


@given(x=st.floats(-2, 14), y=st.floats(-2, 11))
def test_inside_agrees_with_matplotlib(x, y):
    edge = min(abs(x - e) for e in (0, 5, 12)) < 1e-6 or min(abs(y - e) for e in (0, 4, 9)) < 1e-6
    assert edge or inside(np.array([[x, y]]), L_SHAPE)[0] == Polygon(L_SHAPE).contains_point((x, y))


def test_areas_and_ways_around():
    assert area(L_SHAPE) == pytest.approx(12 * 4 + 5 * 5)
    assert area(L_SHAPE[::-1]) == pytest.approx(-73)
    mounts = links.Mounts(links.sides(L_SHAPE), (0.0,))
    assert mounts.length_m == pytest.approx(42)
    around = links.points_along(mounts.segments_m, np.array([0.0, 12.0, 14.0, 23.0, 42.0, 43.0]))
    assert around.tolist() == [[0, 0], [12, 0], [12, 2], [5, 4], [0, 0], [1, 0]]
    assert distance_outside(np.array([8.0, 6.0]), L_SHAPE) == pytest.approx(2.0)
    assert distance_outside(np.array([2.0, 6.0]), L_SHAPE) == 0.0


def test_an_anchor_off_the_floor_is_a_mistake_of_the_file():
    with pytest.raises(ConfigurationError, match=r"anchors\[3\] \(anchor 4\) is .*\(6, 8\).*should be on the floor"):
        links.floor_of(LAB, Path("lab.toml"), np.array([(0.0, 0.0), (6.0, 0.0), (6.0, 5.0)]), None)


def test_anchors_in_one_line_need_an_outline():
    site = replace(LAB, anchors=tuple(AnchorSite(k, float(k), 0.0) for k in range(1, 5)))
    with pytest.raises(ConfigurationError, match="--outline"):
        links.floor_of(site, Path("x.toml"), None, None)
    assert links.floor_of(site, Path("x.toml"), L_SHAPE, None).region_m == (0.0, 0.0, 12.0, 9.0)


def test_only_what_lies_inside_the_outline_counts():
    site = replace(LAB, anchors=LAB.anchors[:1])
    floor = links.floor_of(site, Path("x.toml"), L_SHAPE, None)
    grid = plan_maps.grid_of(floor, (0.0, 1.0), 0.5)
    assert grid.points == 2 * 4 * 73
    with pytest.raises(ValueError, match="inside the outline"):
        plan_maps.grid_of(replace(floor, region_m=(6.0, 5.0, 12.0, 9.0)), (0.0,), 0.5)


def test_a_summary_is_that_of_the_table():
    plan = lab_map()
    sigma = plan.column(links.SIGMA)
    summary = plan_maps.summary_of(plan, 0.034)
    assert summary.points == 12 * 16
    assert summary.mean_sigma_m == pytest.approx(sigma.mean())
    assert summary.worst_sigma_m == sigma.max()
    assert summary.target_share == pytest.approx((sigma <= 0.034).mean())
    x, y, _ = summary.worst_at_m
    k = int(np.argmin(abs(plan.grid.y_m - y))), int(np.argmin(abs(plan.grid.x_m - x)))
    assert sigma[0][k] == sigma.max()


def test_interpolation_of_the_filter_is_close_and_keeps_walls_sharp(monkeypatch):
    """A wall that hides two anchors altogether: what was computed in full every 0.2 m against every 0.8 m."""
    site = replace(LAB, walls=(WallSite(2.0, 3.0, 4.0, 3.0, loss_db=60.0, delay_m=0.0),))
    full = lab_map(0.2, site)
    monkeypatch.setattr(maps, "_JOINT_BUDGET", 1.4e4)
    rough = lab_map(0.2, site)
    assert full.computed_every_m == 0.2
    assert rough.computed_every_m == pytest.approx(0.8)
    assert (rough.column(links.ANCHORS_IN_VIEW) == full.column(links.ANCHORS_IN_VIEW)).all()
    assert (rough.column(links.PDOP) == full.column(links.PDOP)).all()
    errors = rough.column(links.SIGMA) / full.column(links.SIGMA) - 1.0
    assert np.quantile(abs(errors), 0.95) < 0.1
    assert abs(errors.mean()) < 0.02


def test_csv_holds_the_map():
    plan = lab_map(1.0)
    rows = list(csv.DictReader("".join(plan_maps.csv_lines(plan)).splitlines()))
    assert len(rows) == 48
    assert list(rows[0]) == ["x_m", "y_m", "z_m", *links.PLAN_COLUMNS]
    assert [float(row["sigma_m"]) for row in rows] == pytest.approx(plan.column(links.SIGMA).ravel(), rel=1e-3)
    assert (float(rows[1]["x_m"]), float(rows[1]["y_m"])) == (1.5, 0.5)


def test_geojson_has_nulls_where_there_is_no_fix():
    hidden = tuple(WallSite(5.0, y, 7.0, y, loss_db=100.0, delay_m=0.0) for y in (3.0,))
    site = replace(LAB, walls=(*hidden, WallSite(-1.0, 3.0, 5.0, 3.0, loss_db=100.0, delay_m=0.0)))
    collection = json.loads("".join(plan_maps.geojson_lines(lab_map(1.0, site=site), None)))
    assert collection["type"] == "FeatureCollection"
    assert len(collection["features"]) == 48
    north = [f for f in collection["features"] if f["geometry"]["coordinates"][1] > 3.0]
    assert all(f["properties"]["sigma_m"] is None and f["properties"]["fix_share"] == 0 for f in north)
    assert all(f["properties"]["anchors"] <= 4 for f in north)


def test_wgs84_against_known_arcs():
    """One minute of latitude at 45° is 1852.2 m on the ellipsoid, of longitude 1314.11 m (WGS 84 tables)."""
    origin = GeoreferenceSite(45.0, 7.0)
    east, north = plan_maps.to_wgs84(np.array([[1314.11, 0.0, 0.0], [0.0, 1852.2, 2.0]]), origin)
    assert (60 * (east[0] - 7.0), east[1]) == pytest.approx((1.0, 45.0), abs=2e-4)
    assert (60 * (north[1] - 45.0), north[0], north[2]) == pytest.approx((1.0, 7.0, 2.0), abs=2e-4)
    turned = plan_maps.to_wgs84(np.array([[0.0, 1314.11, 0.0]]), replace(origin, heading_deg=90.0))
    assert turned == pytest.approx(east[None], abs=1e-9), "a y axis that points east"
    assert math.isclose(turned[0, 2], 0.0)
