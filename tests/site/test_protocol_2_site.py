"""Site files of protocol 2: modes slots and free, anchors without a position, slots that anchors share."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.errors import ConfigurationError
from skyless.site.advice import warnings_of
from skyless.site.grid import grid_site
from skyless.site.load import load_site
from skyless.site.model import UnplacedAnchor
from skyless.site.near import pairs_within, pairs_within_groups
from skyless.site.slots import beacon_period_s, first_slots, schedule_of
from skyless.site.template import site_template

SLOTS = 'name = "x"\nid = 1\n[schedule]\nmode = "slots"\nslots = 3\n'
FREE = 'name = "x"\nid = 1\n[schedule]\nmode = "free"\n'


def anchor(number, x=None, y=None, **more):
    rows = {"id": number, "x_m": x, "y_m": y, **more}
    return "[[anchors]]\n" + "".join(f"{key} = {value}\n" for key, value in rows.items() if value is not None)


@pytest.fixture
def load(tmp_path):
    def load(text, **options):
        path = tmp_path / "site.toml"
        path.write_text(text)
        return load_site(path, **options)

    return load


def test_anchors_without_a_position_are_kept_apart_and_no_master_is_needed(load):
    site = load(
        SLOTS
        + "site_time = true\nreuse_m = 20.0\n"
        + anchor(5, slot=2, tx_antenna_delay_ticks=16_500)
        + anchor(6, 0, 0, slot=0, floor=-1, zone=7, std_m=0.004)
        + anchor(7, 21, 0, slot=0)
    )
    assert site.master == 5
    assert site.unplaced == (UnplacedAnchor(5, 2, 16_500),)
    assert [(a.id, a.floor, a.zone, a.std_m) for a in site.anchors] == [(6, -1, 7, 0.004), (7, 0, 0, None)]
    assert (site.schedule.site_time, site.schedule.rate_hz) == (True, 30.0)
    assert first_slots(site) == {6: 0, 7: 0, 5: 2}
    assert schedule_of(site).slots == 3
    assert beacon_period_s(site) == pytest.approx(3 * site.schedule.slot_s, rel=1e-5)


def test_a_free_site_has_no_schedule(load):
    site = load(FREE + "rate_hz = 50\n" + anchor(1, 0, 0) + anchor(2))
    assert beacon_period_s(site) == 0.02
    with pytest.raises(ValueError, match="mode free"):
        schedule_of(site)


def test_a_site_may_begin_with_no_position_at_all(load):
    site = load(FREE + anchor(1) + anchor(2))
    assert (site.anchors, len(site.unplaced)) == ((), 2)
    assert "2 of 2 anchors have no position" in warnings_of(site)[0]


def test_slots_need_not_be_given_to_the_planner(load):
    site = load(SLOTS.replace("slots = 3", "") + anchor(1, 0, 0) + anchor(2, 1, 0, slot=200), slots_given=False)
    with pytest.raises(ValueError, match=r"no schedule\.slots yet"):
        schedule_of(site)


@pytest.mark.parametrize(
    ("text", "key", "value", "right"),
    [
        (SLOTS.replace('"slots"', '"slot"') + anchor(1, 0, 0), "schedule.mode", "slot", '"master", "slots" and "free"'),
        (SLOTS + "site_time = 1\n" + anchor(1, 0, 0), "schedule.site_time", 1, "true or false"),
        (SLOTS.replace("slots = 3", "") + anchor(1, 0, 0, slot=0), "schedule.slots", None, "to 255; skyless plan"),
        (SLOTS + anchor(1, 0, 0), "anchors[0].slot (anchor 1)", None, "from 0 to 2; skyless plan"),
        (SLOTS + anchor(9) + anchor(1, 0, 0, slot=0), "anchors[0].slot (anchor 9)", None, "from 0 to 2"),
        (SLOTS + anchor(9, slot=0) + anchor(1, 0, 0, slot=3), "anchors[1].slot (anchor 1)", 3, "from 0 to 2"),
        (
            SLOTS + anchor(9, slot=0) + anchor(1, 0, 0, slot=1) + anchor(2, 0, 77.9, slot=1),
            "anchors[2].slot (anchor 2)",
            1,
            "anchors 1 and 2 share it and are 77.9 m apart, less than schedule.reuse_m, 78 m; skyless plan",
        ),
        (SLOTS + "frames_per_node = 2\n" + anchor(1, 0, 0, slot=0), "schedule.frames_per_node", 2, "1 in mode slots"),
        (SLOTS + "slot_s = 0.0008\n" + anchor(1, 0, 0, slot=0), "schedule.slot_s", 0.0008, "at least 0.000815"),
        (SLOTS + "reuse_m = 0\n" + anchor(1, 0, 0, slot=0), "schedule.reuse_m", 0.0, "from 1 to 10000"),
        (FREE + "rate_hz = 201\n" + anchor(1, 0, 0), "schedule.rate_hz", 201.0, "from 1 to 200"),
        (FREE + anchor(9) + anchor(1, 0, 8389), "anchors[1].y_m (anchor 1)", 8389.0, "from -8388 to 8388"),
        (FREE + anchor(9) + anchor(1, 0, 0, std_m=0.3), "anchors[1].std_m (anchor 1)", 0.3, "from 0 to 0.255"),
        (FREE + anchor(1, 0, 0, floor=128), "anchors[0].floor (anchor 1)", 128, "from -128 to 127"),
        (FREE + anchor(1, 0, 0, zone=-1), "anchors[0].zone (anchor 1)", -1, "from 0 to 255"),
        (FREE + anchor(1, 0, 0) + "[accuracy]\nsurvey_std_m = 0.5\n", "accuracy.survey_std_m", 0.5, "at most 0.255"),
        (FREE + anchor(9) + anchor(1, 0), "anchors[1].y_m (anchor 1)", None, "a number of metres"),
        (FREE + anchor(1, 0, 0) + anchor(9, z_m=3), "anchors[1].z_m (anchor 9)", 3, "given with x_m and y_m"),
        (FREE + anchor(1, 0, 0) + anchor('"a"'), "anchors[1].id (anchor a)", "a", "from 0 to 65533"),
        (FREE + anchor(1, 0, 0) + anchor(3) + anchor(65534), "anchors[2].id (anchor 65534)", 65534, "to 65533"),
        (FREE + anchor(3) + anchor(1, 0, 0) + anchor(3), "anchors[2].id", 3, "anchors[0] has this one"),
        (FREE + anchor(3) + anchor(1, 0, 0) + anchor(2, 0, 0), "anchors[2] (anchor 2)", "at (0.0, 0.0, 0.0)", "r 1 is"),
        (FREE + "[[unplaced]]\nid = 3\n" + anchor(1, 0, 0), "unplaced", [{"id": 3}], "left out"),
        (FREE.replace("id = 1", "id = 1\nmaster = 4") + anchor(1, 0, 0), "master", 4, "the id of an anchor: 1"),
        (FREE.replace("id = 1", "id = 1\nanchors = [5]"), "anchors[0]", 5, "[[anchors]]"),
        (FREE.replace("id = 1", "id = 1\nanchors = 5"), "anchors", 5, "[[anchors]]"),
        (FREE, "anchors", None, "[[anchors]]"),
        ('name = "x"\nid = 1\nmaster = 1\n' + anchor(1), "anchors[0].x_m (anchor 1)", None, "a number of metres"),
    ],
)  # fmt: skip
def test_a_mistake_is_named(load, text, key, value, right):
    with pytest.raises(ConfigurationError) as caught:
        load(text)
    assert (caught.value.key, caught.value.value) == (key, value)
    assert right in caught.value.expected


def test_what_costs_accuracy_is_said(load):
    far = SLOTS + "".join(anchor(k, 300 * (k // 3), 9 * (k % 3), slot=k % 3) for k in range(1, 7)) + anchor(7, slot=0)
    found = " / ".join(warnings_of(load(far)))
    assert "anchor 6: no other anchor within 31 m" in found
    assert "the anchors form 3 groups" in found
    assert "anchor 7: shares its slot" in found
    crowded = FREE + "rate_hz = 100\n" + "".join(anchor(k, k % 4, k // 4) for k in range(16))
    assert "16 anchors in reach of one another send 1600 beacons/s" in warnings_of(load(crowded))[-1]
    assert not any("rate_hz" in warning for warning in warnings_of(load(crowded.replace("100", "59"))))
    three = (anchor(k, k % 3, k // 3 + k % 2, std_m=0.01) for k in (1, 2, 3))
    stated = 'name = "x"\nid = 1\nmaster = 1\n' + "".join(three)
    assert "anchors 1, 2, 3: std_m has no effect" in warnings_of(load(stated))[-1]


@pytest.mark.parametrize("mode", ["slots", "free"])
def test_ten_thousand_anchors_are_written_and_loaded(load, mode):
    site = grid_site(2000.0, 1125.0, 15.0, 4.0, 1.2, mode)
    assert len(site.anchors) == 9975
    assert load(site_template(site)) == site
    assert warnings_of(site) == []


def test_anchors_without_a_position_are_written(load):
    site = grid_site(60.0, 40.0, 10.0, 4.0)
    unplaced = (UnplacedAnchor(900, 24), UnplacedAnchor(901, 25))
    schedule = msgspec.structs.replace(site.schedule, slots=26, site_time=True, reuse_m=70.0)
    site = msgspec.structs.replace(site, unplaced=unplaced, schedule=schedule)
    assert load(site_template(site)) == site


def test_grids():
    site = grid_site(475.0, 475.0, 15.0, 4.0, 1.2)
    assert len(site.anchors) == 1024
    x_m = sorted({a.x_m for a in site.anchors})
    assert (x_m[0], x_m[-1]) == (5.0, 470.0)
    assert np.allclose(np.diff(x_m), 15.0)
    assert grid_site(475.0, 475.0, 15.0, 4.0, 1.2, "free").schedule.rate_hz == 37.0
    wide = grid_site(10_000.0, 10.0, 5.0, 4.0, mode="free")
    assert (wide.anchors[0].x_m, wide.anchors[-1].x_m) == (-4997.5, 4997.5)
    with pytest.raises(ValueError, match="444889 anchors are too many"):
        grid_site(10_000.0, 10_000.0, 15.0, 4.0)


TOML_VALUES = [
    "0", "-1", "1", "3", "70000", "1.5", "nan", "inf", "1e300", '"free"', '"slots"', '"master"', "true", "[]", "{}",
]  # fmt: skip
WRITTEN = SLOTS + "reuse_m = 20.0\nsite_time = true\nrate_hz = 5\nslot_s = 1e-3\nframes_per_node = 1\n"
WRITTEN += anchor(1, 0.5, 0.5, slot=0, floor=1, zone=2, std_m=0.1) + anchor(2, slot=1)
WRITTEN += anchor(3, 25.5, 0.5, slot=0) + anchor(4, slot=2)


@given(st.integers(0, 60), st.sampled_from([*TOML_VALUES, None]))
def test_one_changed_or_missing_value_is_accepted_or_named(tmp_path_factory, line, value):
    lines = WRITTEN.splitlines()
    keys = [number for number, text in enumerate(lines) if " = " in text]
    number = keys[line % len(keys)]
    lines[number] = "" if value is None else f"{lines[number].split(' = ')[0]} = {value}"
    path = tmp_path_factory.getbasetemp() / "changed.toml"
    path.write_text("\n".join(lines))
    try:
        site = load_site(path)
    except ConfigurationError as error:
        assert error.key
        assert error.expected
    else:
        assert isinstance(warnings_of(site), list)


@given(st.integers(0, 2**32 - 1), st.integers(0, 60), st.floats(0.01, 30.0), st.booleans())
def test_near_pairs_are_those_of_a_table_of_all(seed, count, distance_m, flat):
    points = np.random.default_rng(seed).uniform(-10.0, 10.0, (count, 3)).round(0 if flat else 3)
    batches = pairs_within(points, distance_m)
    found = [pair for ones, others, _ in batches for pair in zip(ones.tolist(), others.tolist(), strict=True)]
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert len(found) == len(set(found))
    near = {(i, j) for i in range(count) for j in range(i + 1, count) if apart[i, j] < distance_m}
    assert set(found) == near
    group = np.random.default_rng(seed).integers(-1, 4, count)
    batches = pairs_within_groups(points, group, distance_m)
    found = [pair for ones, others, _ in batches for pair in zip(ones.tolist(), others.tolist(), strict=True)]
    assert len(found) == len(set(found))
    assert set(found) == {(i, j) for i, j in near if group[i] == group[j] >= 0}


CORNERS = anchor(1, 0, 0) + anchor(2, 9, 0) + anchor(3, 0, 9) + anchor(4, 9, 9)
FLAT = "[tags]\nheight_m = 1.0\n"


def test_keys_that_mean_nothing_in_a_mode_are_warned_of(load):
    (warning,) = warnings_of(load(FREE + "site_time = true\n" + FLAT + CORNERS))
    assert warning == "schedule.site_time is true, which has no effect in mode free"
    document = 'name = "x"\nid = 1\nmaster = 1\n[schedule]\nrate_hz = 50.0\n' + FLAT + CORNERS
    rate, floor = warnings_of(load(document.replace("id = 3\n", "id = 3\nfloor = 2\n")))
    assert rate == "schedule.rate_hz is 50.0, which has no effect in mode master"
    assert floor == "anchor 3: floor has no effect in mode master, whose beacons do not carry it"


def test_a_height_that_no_anchor_reaches_is_warned_of(load):
    assert warnings_of(load(FREE + FLAT.replace("1.0", "30.0") + CORNERS)) == []
    (warning,) = warnings_of(load(FREE + FLAT.replace("1.0", "-32.0") + CORNERS))
    assert warning.startswith("tags.height_m is -32: no anchor is within 31 m")


def test_lines_are_judged_by_what_is_in_reach(load):
    """A corridor of three rows is no line, however long; a row that leaves a hall is one."""
    corridor = "".join(anchor(3 * k + row + 1, 15 * k, 15 * row) for k in range(60) for row in range(3))
    assert warnings_of(load(FREE + FLAT + corridor)) == []
    row = "".join(anchor(500 + k, 15 * (60 + k), 0) for k in range(8))
    (warning,) = warnings_of(load(FREE + FLAT + corridor + row))
    assert warning.startswith("anchors 501, 502, 503, 504, 505, 506, 507: all anchors in reach lie nearly in one line")
    (warning,) = warnings_of(load(FREE + FLAT + row))
    assert warning.startswith("all anchors lie nearly in one line")


def test_a_missing_coordinate_has_the_limits_of_the_mode(load):
    with pytest.raises(ConfigurationError, match="from -8388 to 8388"):
        load(FREE + anchor(1, 0))


def test_slots_that_are_there_are_replaced_with_force(load):
    with pytest.raises(ConfigurationError, match="plan --write colours"):
        load(SLOTS.replace("slots = 3\n", "") + anchor(1, 0, 0) + anchor(2, 9, 0))
    with pytest.raises(ConfigurationError, match="plan --write --force colours"):
        load(SLOTS + anchor(1, 0, 0, slot=0) + anchor(2, 9, 0))
