"""Floors of a site: which a tag is on, zones that lie on one, and what a site's file may say."""

from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.errors import ConfigurationError
from skyless.core.site import FloorSite
from skyless.run.mqtt.messages import SiteMessage, Zone, read_message, site_message
from skyless.run.zones import ZoneMonitor, floor_at
from skyless.sim.lab import lab_site
from skyless.site.file.check import plan_files
from skyless.site.file.load import load_site
from skyless.site.file.template import site_template
from support.site_messages import a_fix, diagonal

FLOORS = (FloorSite(-1, -3.0), FloorSite(0, 0.0), FloorSite(2, 6.5))
PNG = b"\x89PNG\r\n\x1a\n" + bytes(4) + b"IHDR" + (9).to_bytes(4) + (7).to_bytes(4)
SITE = """
name = "House"
id = 3
master = 1
anchors = [{id = 1, x_m = 0, y_m = 0}, {id = 2, x_m = 9, y_m = 0}, {id = 3, x_m = 0, y_m = 9, z_m = 8}]
"""


def fix(z_m, height_known=False):
    covariance = diagonal(0.01, 0.01, 0.0 if height_known else 0.01)
    return a_fix(position_m=(2.0, 2.0, z_m), covariance_m2=covariance, height_known=height_known)


@given(st.floats(-20.0, 20.0), st.floats(0.0, 5.0))
def test_a_tag_without_a_past_is_on_the_floor_below_it(z_m, std_m):
    expected = -1 if z_m < 0.0 else 0 if z_m < 6.5 else 2
    assert floor_at(FLOORS, z_m, std_m, None) == expected
    assert floor_at(FLOORS, z_m, std_m, 77) == expected
    assert floor_at((), z_m, std_m, 0) is None


@given(st.lists(st.floats(-0.9, 0.9), min_size=1, max_size=30), st.sampled_from([(0.0, 0), (6.5, 2)]))
def test_noise_within_the_margin_changes_no_floor(errors_m, boundary):
    """At a boundary, with a standard deviation of 0.3 m, so a margin of 0.9 m."""
    boundary_m, above = boundary
    below = -1 if above == 0 else 0
    for start in (below, above):
        floor = start
        for error_m in errors_m:
            floor = floor_at(FLOORS, boundary_m + error_m * 0.999, 0.3, floor)
        assert floor == start
    assert floor_at(FLOORS, boundary_m + 1.0, 0.3, below) == above
    assert floor_at(FLOORS, boundary_m + 2.5, 9.0, below) == above  # however wide, a third of a storey decides


def test_a_zone_on_a_floor_holds_its_tags_only():
    square = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))
    monitor = ZoneMonitor()
    monitor.floors = FLOORS
    monitor.set_zones((Zone("up", "Up", square, floor=2), Zone("all", "All", square)), 0.0)
    assert {(e.zone, e.kind) for e in monitor.update(fix(1.0))} == {("all", "enter")}
    assert [(e.zone, e.kind) for e in monitor.update(fix(8.0))] == [("up", "enter")]
    assert [(e.zone, e.kind) for e in monitor.update(fix(1.0))] == [("up", "leave")]
    assert {e.zone for e in monitor.update(fix(1.0, height_known=True))} == {"up"}


def test_the_file_s_floors_travel_beside_the_site(tmp_path):
    file = tmp_path / "site.toml"
    (tmp_path / "up.png").write_bytes(PNG)
    file.write_text(
        SITE + '[[floors]]\nnumber = 0\nlow_m = 0.0\n[[floors]]\nnumber = 1\nlow_m = 3.2\nname = "Up"\n'
        'image = "up.png"\nwidth_m = 24.0\n'
    )
    site = load_site(file)
    assert [floor.name for floor in site.floors] == ["", "Up"]
    assert plan_files(site, file) == {1: tmp_path / "up.png"}
    payload = msgspec.json.encode(site_message(site, simulated=True, unix_s=1.0))
    assert msgspec.json.decode(payload)["site"].keys().isdisjoint({"floors", "outline_m"})
    assert read_message(payload, SiteMessage).whole_site == site


@pytest.mark.parametrize(
    ("floors", "key", "right"),
    [
        ("[[floors]]\nnumber = 1\nlow_m = 0\n[[floors]]\nnumber = 1\nlow_m = 3\n", "floors[1].number", "above 1"),
        ("[[floors]]\nnumber = 1\nlow_m = 2\n[[floors]]\nnumber = 2\nlow_m = 2\n", "floors[1].low_m", "above 2"),
        ("[[floors]]\nnumber = 1\n", "floors[0].low_m", "a number of metres"),
        ("[[floors]]\nnumber = 1.5\nlow_m = 2\n", "floors[0].number", "a whole number"),
        ('[[floors]]\nnumber = 1\nlow_m = 2\nimage = "a.png"\n', "floors[0].width_m", "belong together"),
        (
            '[[floors]]\nnumber = 1\nlow_m = 2\nimage = "a.png"\nwidth_m = 3\n',
            "floors[0].image",
            "a file that can be read",
        ),
        ("[[floors]]\nnumber = 1\nlow_m = 2\nlevel = 3\n", "floors[0].level", "left out"),
    ],
)
def test_wrong_floors_are_named(tmp_path, floors, key, right):
    file = tmp_path / "site.toml"
    file.write_text(SITE + floors)
    with pytest.raises(ConfigurationError) as refused:
        load_site(file)
    assert refused.value.key == key
    assert right in refused.value.expected
    assert Path(str(refused.value).split(":")[0]).name == "site.toml"


def test_a_site_is_written_with_its_floors(tmp_path):
    file = tmp_path / "site.toml"
    floors = FloorSite(0, 0.0, "Ground"), FloorSite(1, 3.2, 'Ü "1"', "up.png", 24.0, -1.0, 2.0)
    (tmp_path / "up.png").write_bytes(PNG)
    site = replace(lab_site(), floors=floors)
    file.write_text(site_template(site), encoding="utf-8")
    assert load_site(file) == site


def test_a_site_without_floors_is_as_before(tmp_path):
    file = tmp_path / "site.toml"
    file.write_text(SITE)
    site = load_site(file)
    assert plan_files(site, file) == {}
