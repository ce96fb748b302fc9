"""The outline of a room: as it is written so it is read, and a survey's values leave it; wrong ones are refused."""

import math
import tomllib
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET
from msgspec.structs import replace

from skyless.core.errors import ConfigurationError
from skyless.core.geometry import rectangle_of, sides_that_meet
from skyless.core.site import Site, site_digest
from skyless.run.mqtt.messages import SiteMessage, site_message
from skyless.sim.evaluation.scenarios import patrols, wanderers
from skyless.sim.lab import lab_site
from skyless.site.file.advice import warnings_of
from skyless.site.file.check import check_site
from skyless.site.file.load import load_site, with_values
from skyless.site.file.template import rectangle, rectangular_site, site_template
from skyless.site.planning.links import floor_of

LAB = lab_site()
ROOM = replace(LAB, outline_m=rectangle(6.0, 8.0))


@st.composite
def outlines(draw):
    """Polygons around (3, 4): one corner in each of some directions, so that no sides cross."""
    count = draw(st.integers(3, 12))
    radii_m = draw(st.lists(st.floats(1.0, 50.0), min_size=count, max_size=count))
    angles = [2 * math.pi * number / count for number in range(count)]
    return tuple(
        (3.0 + radius * math.cos(angle), 4.0 + radius * math.sin(angle))
        for radius, angle in zip(radii_m, angles, strict=True)
    )


@pytest.mark.site
@given(outlines(), st.booleans())
def test_an_outline_is_read_as_written_also_after_a_survey_was_saved(tmp_path_factory, outline_m, in_lines):
    site = replace(LAB, outline_m=outline_m)
    file = tmp_path_factory.getbasetemp() / "outlined.toml"
    text = site_template(site)
    if in_lines:
        text = text.replace("outline_m = [[", "outline_m = [\n  [").replace("], [", "],  # a corner\n  [")
    file.write_text(text)
    assert load_site(file) == site
    surveyed = with_values(text, {1: {"x_m": 0.25}}, {"accuracy": {"survey_std_m": 0.01}}, file, "the survey")
    assert tomllib.loads(surveyed)["outline_m"] == [list(corner) for corner in outline_m]
    file.write_text(surveyed)
    assert load_site(file).outline_m == outline_m


@given(outlines().filter(lambda corners: len(corners) > 3))
def test_corners_that_are_not_in_their_order_are_found(outline_m):
    assert sides_that_meet(np.array(outline_m)) is None
    convex = [(math.cos(angle), math.sin(angle)) for angle in np.arange(len(outline_m)) * 2 * math.pi / len(outline_m)]
    convex[0], convex[1] = convex[1], convex[0]
    assert sides_that_meet(np.array(convex)) is not None


@pytest.mark.parametrize(
    ("outline", "key", "right"),
    [
        ("[[0, 0], [6, 0]]", "outline_m", "3 to 1000 corners"),
        ('[[0, 0], [6, 0], [6, "8"]]', "outline_m[2][1]", "[x, y] each in metres"),
        ("[[0, 0], [6, 0], [6]]", "outline_m[2]", "[x, y] each in metres"),
        ("12", "outline_m", "[x, y] each in metres"),
        ("[[0, 0], [6, nan], [6, 8]]", "outline_m[1][1]", "a number of metres"),
        ("[[0, 0], [6, 0], [6, 8], [0, 0]]", "outline_m[0]", "elsewhere than the corner before it"),
        ("[[0, 0], [6, 8], [6, 0], [0, 8]]", "outline_m", "no two sides meet"),
        ("[[0, 0], [3, 0], [6, 0]]", "outline_m", "in order"),
        ("[[0, 0], [0.0009, 0], [6, 8]]", "outline_m[1]", "elsewhere than the corner before it"),
    ],
)
def test_a_wrong_outline_is_refused_by_its_key(tmp_path, outline, key, right):
    file = tmp_path / "hall.toml"
    file.write_text(f"outline_m = {outline}\n" + site_template(LAB))
    with pytest.raises(ConfigurationError) as raised:
        load_site(file)
    assert (raised.value.key, str(file) in str(raised.value)) == (key, True)
    assert right in str(raised.value)


def test_anchors_outside_are_a_warning_and_the_planner_goes_on():
    off = replace(ROOM, anchors=(*ROOM.anchors[:-1], replace(ROOM.anchors[-1], x_m=-2.5)))
    check_site(off, Path("off.toml"))
    assert warnings_of(ROOM) == []
    assert [text for text in warnings_of(off) if "outline_m" in text] == [
        "anchor 6: 2.50 m outside the room that outline_m gives; see which of the two is wrong"
    ]
    assert floor_of(off, Path("off.toml"), None, None).region_m == (0.0, 0.0, 6.0, 8.0)


def test_a_new_room_keeps_its_size_and_is_where_tags_walk_and_plans_look():
    room = rectangular_site(12.0, 8.0, 6, 3.0, 1.2)
    inner = tuple(replace(one, x_m=1.0 + one.x_m * 10 / 12, y_m=1.0 + one.y_m * 6 / 8) for one in room.anchors)
    room = replace(room, anchors=inner)
    guessed = replace(room, outline_m=UNSET)
    assert rectangle_of(room) == floor_of(room, Path("room.toml"), None, None).region_m == (0.0, 0.0, 12.0, 8.0)
    assert floor_of(guessed, Path("room.toml"), None, None).region_m == pytest.approx((1.0, 1.0, 11.0, 7.0))
    ways = [[patrols(site, 1)[0].position(time)[:2] for time in np.arange(0.0, 40.0, 0.1)] for site in (room, guessed)]
    wide, narrow = (np.ptp(way, axis=0) for way in ways)
    assert wide == pytest.approx(narrow + 2.0, abs=0.1)
    assert rectangle_of(replace(room, outline_m=((0.0, 0.0), (9.0, 0.0), (9.0, 9.0)))) is None


def test_an_outline_that_says_what_was_guessed_changes_nothing():
    given, guessed = wanderers(ROOM, 2, 7), wanderers(LAB, 2, 7)
    times = np.linspace(0.0, 9.0, 50)
    for one, other in zip(given, guessed, strict=True):
        assert [one.position(time).tolist() for time in times] == [other.position(time).tolist() for time in times]
    assert site_digest(ROOM) == site_digest(LAB)


def test_readers_of_before_understand_the_message():
    """A site had no outline and was refused with a field that it did not know."""
    fields = [field for field in msgspec.structs.fields(Site) if field.name != "outline_m"]
    old_site = msgspec.defstruct(
        "Site",
        [(field.name, field.type) if field.required else (field.name, field.type, None) for field in fields],
        forbid_unknown_fields=True,
    )
    old_message = msgspec.defstruct("SiteMessage", [("site", old_site), ("simulated", bool), ("unix_s", float)])
    written = msgspec.json.encode(site_message(ROOM, simulated=True, unix_s=1.0))
    assert msgspec.json.decode(written, type=old_message).site.anchors == ROOM.anchors
    assert msgspec.json.decode(written, type=SiteMessage).whole_site == ROOM
    of_before = msgspec.json.encode(site_message(LAB, simulated=True, unix_s=1.0))
    assert b"outline" not in of_before
    assert msgspec.json.decode(of_before, type=SiteMessage).whole_site == LAB
