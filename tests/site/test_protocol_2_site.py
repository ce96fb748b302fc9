"""Site files of protocol 2: mode free, anchors without a position, large sites."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.almanac import OFFERED_HZ, SHORTEST_PERIOD_S
from skyless.core.any_anchor import beacon_period_s
from skyless.core.errors import ConfigurationError
from skyless.core.geometry import pairs_within
from skyless.core.site import UnplacedAnchor
from skyless.site.file.advice import warnings_of
from skyless.site.file.load import load_site
from skyless.site.file.template import grid_site, site_template

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
        FREE
        + anchor(5, tx_antenna_delay_ticks=16_500)
        + anchor(6, 0, 0, floor=-1, zone=7, std_m=0.004)
        + anchor(7, 21, 0)
    )
    assert site.master == 5
    assert site.unplaced == (UnplacedAnchor(5, tx_antenna_delay_ticks=16_500),)
    assert [(a.id, a.floor, a.zone, a.std_m) for a in site.anchors] == [(6, -1, 7, 0.004), (7, 0, 0, None)]


def test_the_rate_of_anchors_is_that_of_the_file_or_follows_from_how_many_are_in_reach(load):
    anchors = anchor(1, 0, 0) + anchor(2)
    assert beacon_period_s(load(FREE + "rate_hz = 50\n" + anchors)) == 0.02
    assert beacon_period_s(load(FREE + anchors)) == SHORTEST_PERIOD_S
    assert beacon_period_s(grid_site(475.0, 475.0, 15.0, 4.0)) == pytest.approx(13 / OFFERED_HZ)


@pytest.mark.parametrize("value", ["true", "false", None])
def test_phases_are_relayed_where_the_file_says_so(load, value):
    """A site without the key has none in messages: earlier versions refuse keys that they do not know."""
    schedule = FREE if value is None else f"{FREE}carrier_phase = {value}\n"
    site = load(schedule + anchor(1, 0, 0))
    assert site.schedule.sends_phases is (value == "true")
    assert (b"carrier_phase" in msgspec.json.encode(site)) is (value is not None)
    assert load(site_template(site)) == site
    assert msgspec.json.decode(msgspec.json.encode(site), type=type(site)) == site


def test_a_site_may_begin_with_no_position_at_all(load):
    site = load(FREE + anchor(1) + anchor(2))
    assert (site.anchors, len(site.unplaced)) == ((), 2)
    assert "2 of 2 anchors have no position" in warnings_of(site)[0]


@pytest.mark.parametrize(
    ("text", "key", "value", "right"),
    [
        (FREE.replace('"free"', '"fre"') + anchor(1, 0, 0), "schedule.mode", "fre", '"master" or "free"'),
        (FREE.replace('"free"', '"slots"') + anchor(1, 0, 0, slot=0), "schedule.mode", "slots", '"free": without a'),
        (FREE + "reuse_m = 78.0\n" + anchor(1, 0, 0), "schedule.reuse_m", 78.0, "left out"),
        (FREE + "site_time = true\n" + anchor(1, 0, 0), "schedule.site_time", True, "left out"),
        (FREE + "rate_hz = 201\n" + anchor(1, 0, 0), "schedule.rate_hz", 201.0, "from 1 to 200"),
        (FREE + "carrier_phase = 1\n" + anchor(1, 0, 0), "schedule.carrier_phase", 1, "true or false"),
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
    far = FREE + "".join(anchor(k, 300 * (k // 3), 9 * (k % 3)) for k in range(1, 7))
    found = " / ".join(warnings_of(load(far)))
    assert "anchor 6: no other anchor within 31 m" in found
    assert "the anchors form 3 groups" in found
    crowded = FREE + "rate_hz = 100\n" + "".join(anchor(k, k % 4, k // 4) for k in range(16))
    assert "16 anchors in reach of one another send 1600 beacons/s" in warnings_of(load(crowded))[-1]
    assert not any("rate_hz" in warning for warning in warnings_of(load(crowded.replace("100", "59"))))
    three = (anchor(k, k % 3, k // 3 + k % 2, std_m=0.01) for k in (1, 2, 3))
    stated = 'name = "x"\nid = 1\nmaster = 1\n' + "".join(three)
    assert "anchors 1, 2, 3: std_m has no effect" in warnings_of(load(stated))[-1]


@pytest.mark.site
def test_ten_thousand_anchors_are_written_and_loaded(load):
    site = grid_site(2000.0, 1125.0, 15.0, 4.0, 1.2)
    assert len(site.anchors) == 9975
    assert load(site_template(site)) == site
    assert warnings_of(site) == []


def test_anchors_without_a_position_are_written(load):
    site = grid_site(60.0, 40.0, 10.0, 4.0)
    site = msgspec.structs.replace(site, unplaced=(UnplacedAnchor(900), UnplacedAnchor(901)))
    assert load(site_template(site)) == site


def test_grids():
    site = grid_site(475.0, 475.0, 15.0, 4.0, 1.2)
    assert len(site.anchors) == 1024
    x_m = sorted({a.x_m for a in site.anchors})
    assert (x_m[0], x_m[-1]) == (5.0, 470.0)
    assert np.allclose(np.diff(x_m), 15.0)
    assert site.schedule.rate_hz is None
    wide = grid_site(10_000.0, 10.0, 5.0, 4.0)
    assert (wide.anchors[0].x_m, wide.anchors[-1].x_m) == (-4997.5, 4997.5)
    with pytest.raises(ValueError, match="444889 anchors are too many"):
        grid_site(10_000.0, 10_000.0, 15.0, 4.0)


TOML_VALUES = [
    "0", "-1", "1", "3", "70000", "1.5", "nan", "inf", "1e300", '"free"', '"slots"', '"master"', "true", "[]", "{}",
]  # fmt: skip
WRITTEN = FREE + "rate_hz = 5\ncarrier_phase = false\nslot_s = 1e-3\nframes_per_node = 1\nslots = 3\n"
WRITTEN += anchor(1, 0.5, 0.5, slot=0, floor=1, zone=2, std_m=0.1) + anchor(2, slot=1)
WRITTEN += anchor(3, 25.5, 0.5) + anchor(4)


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


CORNERS = anchor(1, 0, 0) + anchor(2, 9, 0) + anchor(3, 0, 9) + anchor(4, 9, 9)
FLAT = "[tags]\nheight_m = 1.0\n"


def test_keys_that_mean_nothing_in_a_mode_are_warned_of(load):
    slots, slot = warnings_of(load(FREE + "slots = 8\n" + FLAT + CORNERS.replace("id = 3\n", "id = 3\nslot = 2\n")))
    assert slots == "schedule.slots is 8, which has no effect in mode free"
    assert slot == "anchor 3: slot has no effect in mode free"
    document = 'name = "x"\nid = 1\nmaster = 1\n[schedule]\nrate_hz = 50.0\ncarrier_phase = true\n' + FLAT + CORNERS
    assert not load(document).schedule.sends_phases
    rate, phase, floor = warnings_of(load(document.replace("id = 3\n", "id = 3\nfloor = 2\n")))
    assert rate == "schedule.rate_hz is 50.0, which has no effect in mode master"
    assert phase == "schedule.carrier_phase is true, which has no effect in mode master"
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
