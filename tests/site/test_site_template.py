"""Templates: they load, equal what they were made from, and leave no key unexplained."""

import re
import tomllib

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.site import EXACT, AccuracySite, Site
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.site.file.advice import warnings_of
from skyless.site.file.load import load_site
from skyless.site.file.template import rectangular_site, site_template


def reload(tmp_path, site):
    path = tmp_path / "site.toml"
    path.write_text(site_template(site), encoding="utf-8")
    return load_site(path)


def test_the_template_of_the_lab_is_the_lab(tmp_path):
    assert reload(tmp_path, lab_site()) == lab_site()


@given(
    st.builds(
        AccuracySite,
        *[st.floats(0.0, 6.5)] * 4,
        st.floats(0.0, 650.0, exclude_min=True),
        st.floats(0.0, 6000.0, exclude_min=True),
    )
)
def test_accuracy_is_written_as_it_is(tmp_path_factory, accuracy):
    site = paper_lab_site(accuracy=accuracy)
    assert reload(tmp_path_factory.getbasetemp(), site) == site


def test_the_exact_lab_is_written_as_it_is(tmp_path):
    assert reload(tmp_path, lab_site(accuracy=EXACT)).accuracy == EXACT


def test_the_lab_is_the_published_one():
    """docs/maths.md section 5."""
    site = paper_lab_site(accuracy=AccuracySite())
    assert [(a.x_m, a.y_m, a.z_m) for a in site.anchors] == [
        (0, 0, 0), (6, 0, 0), (6, 4, 0), (6, 8, 0), (0, 8, 0), (0, 4, 0),
    ]  # fmt: skip
    assert (site.master, site.schedule.slot_s, site.schedule.frames_per_node) == (1, 0.0025, 1)
    assert (site.noise.white_fm, site.noise.random_walk_fm, site.tags.height_m) == (2e-11, 1e-9, 0.0)
    assert warnings_of(site) == []


PAPER = paper_lab_site(accuracy=AccuracySite())
IN_FREE_MODE = {"rate_hz", "carrier_phase", "floor", "zone", "std_m"}
IN_MASTER_MODE = {"master", "slot_s", "guard_s", "frames_per_node", "slots", "slot"}


@pytest.mark.parametrize(("lab", "others"), [(lab_site(), IN_MASTER_MODE), (PAPER, IN_FREE_MODE)])
def test_every_key_of_its_mode_stands_in_the_template(lab, others):
    """With the comment signs taken from its examples, the template holds each key of the model but the other mode's."""
    text = re.sub(r"^# ?(?=\[|\w+ = )", "", site_template(lab), flags=re.MULTILINE)
    optional = re.compile(r"^#   (\w+ = [\d.]+).*\n", re.MULTILINE)
    text = optional.sub("", text).replace("[[anchors]]", "\n".join(["[[anchors]]", *optional.findall(text)]), 1)
    document = tomllib.loads(text)
    site = msgspec.convert({"master": 1, **document}, Site)
    assert set(document) == set(Site.__struct_fields__) - {"unplaced"} - others
    for name, table in document.items():
        struct = getattr(site, name)
        if name == "alarms":  # each kind of rule has keys of its own
            assert set(table[0]) >= {"id", "kind"}
        elif isinstance(struct, tuple) and isinstance(struct[0], msgspec.Struct):
            assert set(table[0]) == set(struct[0].__struct_fields__) - others
        elif isinstance(struct, msgspec.Struct):
            assert set(table) == set(struct.__struct_fields__) - {"site_time"} - others


@pytest.mark.site
@given(st.floats(1, 500), st.floats(1, 500), st.integers(1, 60), st.floats(0.5, 30), st.none() | st.floats(-5, 30))
def test_rooms_load_and_their_anchors_hang_on_the_walls(tmp_path_factory, width, depth, anchors, height, tag_height):
    site = rectangular_site(width, depth, anchors, height, tag_height)
    assert reload(tmp_path_factory.getbasetemp(), site) == site
    assert len(site.anchors) == anchors
    for a in site.anchors:
        assert min(abs(a.x_m), abs(a.x_m - width), abs(a.y_m), abs(a.y_m - depth)) < 1e-3
        assert -1e-3 < a.x_m < width + 1e-3
        assert -1e-3 < a.y_m < depth + 1e-3
        assert 0 <= a.z_m <= height


def test_room_of_the_handbook():
    site = rectangular_site(6, 8, 4, 3, None)
    assert [(a.x_m, a.y_m, a.z_m) for a in site.anchors] == [(0, 0, 2.5), (6, 1, 0.5), (6, 8, 2.5), (0, 7, 0.5)]
    assert [a.z_m for a in rectangular_site(6, 8, 4, 3, 1.0).anchors] == [2.5] * 4


@pytest.mark.parametrize("anchors", range(5, 13))
def test_rooms_have_a_good_geometry(anchors):
    assert warnings_of(rectangular_site(12, 8, anchors, 3, None)) == []
    assert warnings_of(rectangular_site(12, 8, anchors, 3, 1.2)) == []


def test_names_are_quoted(tmp_path):
    site = msgspec.structs.replace(lab_site(), name='Süd "7" \\ \t\n𝄞')
    assert reload(tmp_path, site) == site
