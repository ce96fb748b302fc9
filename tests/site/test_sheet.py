"""The installer's sheet: its numbers, and that its file is a page for each floor."""

import json
import math
import re
import struct

import pytest
from msgspec.structs import replace

from skyless.cli.main import main
from skyless.core.errors import ConfigurationError
from skyless.core.site import AnchorSite, Site, UnplacedAnchor
from skyless.site.file.template import grid_site, rectangular_site, site_template
from skyless.site.planning.sheet import mounts, sheet

ROOM = rectangular_site(12.0, 7.0, 8, 3.0, None)
A4_PIXELS = (909, 1285)


def pages(pdf):
    assert pdf.startswith(b"%PDF-")
    assert pdf.rstrip().endswith(b"%%EOF")
    return len(re.findall(rb"/Type\s*/Page\b", pdf))


def png_size(data):
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    return struct.unpack(">II", data[16:24])


def test_cables_are_straight_and_along_the_axes():
    rows = mounts(ROOM, (1.0, 2.0, 0.5))
    for row in rows:
        dx, dy, dz = row.anchor.x_m - 1.0, row.anchor.y_m - 2.0, row.anchor.z_m - 0.5
        assert row.cable_m == pytest.approx((math.sqrt(dx * dx + dy * dy + dz * dz), abs(dx) + abs(dy) + abs(dz)))
    assert [row.anchor.id for row in rows] == list(range(1, 9))
    assert all(row.cable_m is None for row in mounts(ROOM))


@pytest.mark.site
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
def test_the_command_writes_a_sheet_and_nothing_over_another_file(tmp_path, capsys, complaint):
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
        assert right in complaint(*arguments)
    assert main([*command, "--force"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sheet.pdf", "site.toml"]
