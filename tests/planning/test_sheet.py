"""The installer's sheet: its numbers, and that its file is a page for each floor."""

import json
import math
import re
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET
from msgspec.structs import replace

from skyless.cli.main import main
from skyless.core.errors import ConfigurationError
from skyless.core.site import AnchorSite, Site, UnplacedAnchor
from skyless.site.file.template import grid_site, rectangular_site, site_template
from skyless.site.planning.sheet import mounts, sheet, wall_distances

ROOM = rectangular_site(12.0, 7.0, 8, 3.0, None)
A4_PIXELS = (909, 1285)


def pages(pdf):
    assert pdf.startswith(b"%PDF-")
    assert pdf.rstrip().endswith(b"%%EOF")
    return len(re.findall(rb"/Type\s*/Page\b", pdf))


def png_size(data):
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    return struct.unpack(">II", data[16:24])


@given(st.floats(0.0, 12.0), st.floats(0.0, 7.0))
def test_in_a_rectangle_the_distances_are_those_of_the_nearest_walls(x, y):
    corners = np.array([(0.0, 0.0), (12.0, 0.0), (12.0, 7.0), (0.0, 7.0)])
    found = wall_distances(np.array([x, y]), corners)
    of = {"A": y, "B": 12.0 - x, "C": 7.0 - y, "D": x}
    assert len(found) == 2
    for side, distance_m in found.items():
        assert distance_m == pytest.approx(of[side], abs=1e-9)
    assert min(found.values()) == pytest.approx(min(of.values()), abs=1e-9)
    assert sum(side in "AC" for side in found) == 1


@given(st.floats(0.0, 2.0 * math.pi), st.floats(-5.0, 5.0), st.floats(0.3, 3.7), st.floats(0.3, 2.7))
def test_distances_do_not_depend_on_how_the_room_lies(turn, shift, x, y):
    corners = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0)])
    rotation = np.array([(math.cos(turn), -math.sin(turn)), (math.sin(turn), math.cos(turn))])
    there = wall_distances(rotation @ np.array([x, y]) + shift, corners @ rotation.T + shift)
    assert sorted(there.values()) == pytest.approx(sorted([min(x, 4.0 - x), min(y, 3.0 - y)]))


def test_in_a_room_with_a_corner_cut_out_walls_beside_the_anchor_come_first():
    """The nearest line may be that of a wall that ends before the anchor."""
    room = np.array([(0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (2.0, 4.0), (2.0, 8.0), (0.0, 8.0)])
    found = wall_distances(np.array([5.0, 3.5]), room)
    assert found == pytest.approx({"C": 0.5, "B": 1.0})
    found = wall_distances(np.array([1.5, 3.9]), room)
    assert found["F"] == pytest.approx(1.5)


def test_cables_are_straight_and_along_the_axes():
    rows = mounts(ROOM, (1.0, 2.0, 0.5))
    for row in rows:
        dx, dy, dz = row.anchor.x_m - 1.0, row.anchor.y_m - 2.0, row.anchor.z_m - 0.5
        assert row.cable_m == pytest.approx((math.sqrt(dx * dx + dy * dy + dz * dz), abs(dx) + abs(dy) + abs(dz)))
    assert [row.anchor.id for row in rows] == list(range(1, 9))
    assert all(row.cable_m is None for row in mounts(ROOM))


def test_without_an_outline_there_are_no_distances_from_walls():
    assert not any(row.walls_m for row in mounts(replace(ROOM, outline_m=UNSET)))
    assert pages(sheet(replace(ROOM, outline_m=UNSET), None, "pdf", "2026-01-02")) == 1


def test_a_page_for_each_floor_and_more_where_anchors_do_not_fit():
    upstairs = tuple(replace(one, id=one.id + 100, floor=1, z_m=one.z_m + 4.0) for one in ROOM.anchors)
    two = replace(ROOM, anchors=(*ROOM.anchors, *upstairs))
    assert pages(sheet(two, None, "pdf", "2026-01-02", (0.0, 0.0, 0.0))) == 2
    assert png_size(sheet(two, None, "png", "2026-01-02")) == (A4_PIXELS[0], 2 * A4_PIXELS[1])
    many = grid_site(30.0, 30.0, 5.0, 4.0, 1.2)
    assert len(many.anchors) > 26
    assert pages(sheet(many, None, "pdf", "2026-01-02")) == 1 + math.ceil((len(many.anchors) - 26) / 60)


def test_the_same_site_gives_the_same_bytes():
    assert sheet(ROOM, None, "pdf", "2026-01-02") == sheet(ROOM, None, "pdf", "2026-01-02")


def test_a_site_without_positions_has_no_sheet():
    bare = Site("bare", 1, 1, (), unplaced=(UnplacedAnchor(1),))
    with pytest.raises(ConfigurationError, match="skyless survey"):
        sheet(bare, None, "pdf", "2026-01-02")
    line = Site("line", 1, 1, tuple(AnchorSite(n, float(n), 0.0) for n in range(1, 4)))
    with pytest.raises(ConfigurationError, match="in one line"):
        sheet(line, None, "pdf", "2026-01-02")


@pytest.mark.site
def test_the_command_writes_a_sheet_and_nothing_over_another_file(tmp_path, capsys):
    site, out = tmp_path / "site.toml", tmp_path / "sheet.pdf"
    site.write_text(site_template(ROOM), encoding="utf-8")
    command = ["site", "sheet", str(site), str(out)]
    assert main([*command, "--cables-from", "0.5,0.5", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [row["anchor"]["id"] for row in found["anchors"]] == list(range(1, 9))
    assert pages(out.read_bytes()) == 1
    for arguments, right in (
        (command, "--force overwrites it"),
        ([*command[:3], str(tmp_path / "sheet.svg")], "its ending should be .pdf or .png"),
        ([*command[:3], str(tmp_path / "no" / "sheet.pdf")], "a folder that exists"),
        ([*command, "--force", "--cables-from", "1"], "2 or 3 numbers"),
        (["site", "sheet", str(tmp_path / "none.toml"), str(tmp_path / "x.pdf")], "none.toml"),
    ):
        assert main(arguments) == 2
        assert right in capsys.readouterr().err
    assert main([*command, "--force"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sheet.pdf", "site.toml"]
