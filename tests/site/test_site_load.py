"""Site files: what is accepted, and that every mistake is told with file, key, value and what would be right."""

import re

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.frame import MAX_FRAME_BYTES, air_time_s
from skyless.core.errors import ConfigurationError
from skyless.core.site import AccuracySite
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.site.file.check import HALF_WRAP_S, SITE_LIMITS
from skyless.site.file.load import load_site
from skyless.site.file.template import site_template

LAB = site_template(lab_site())
PAPER = site_template(paper_lab_site())
HEAD = 'name = "x"\nid = 1\nmaster = 1\n'


def anchor(number, x, y, **more):
    rows = {"id": number, "x_m": x, "y_m": y, **more}
    return "[[anchors]]\n" + "".join(f"{key} = {value}\n" for key, value in rows.items())


THREE = anchor(1, 0, 0) + anchor(2, 6, 0) + anchor(7, 0, 8)
PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x10\0\0\0\x08\x08\x02\0\0\0"


@pytest.fixture
def load(tmp_path):
    def load(text):
        path = tmp_path / "site.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return load_site(path)

    return load


@pytest.fixture
def refused(load, tmp_path):
    def refused(text):
        with pytest.raises(ConfigurationError) as caught:
            load(text)
        assert str(caught.value).startswith(str(tmp_path / "site.toml"))
        return caught.value

    return refused


def test_a_byte_order_mark_does_no_harm(load):
    assert load(b"\xef\xbb\xbf" + LAB.encode()) == load(LAB)


def test_least_file(load):
    site = load(HEAD + THREE)
    assert [a.id for a in site.anchors] == [1, 2, 7]
    assert site.anchors[2].y_m == 8.0
    assert site.tags.height_m is None
    assert site.accuracy == AccuracySite(0.02, 0.03, 0.05, 0.005, 1.0, 100.0)


def test_every_table(load, tmp_path):
    (tmp_path / "floor.png").write_bytes(PNG)
    site = load(
        HEAD
        + "[schedule]\nslot_s = 0.001\nslots = 9\nframes_per_node = 2\nguard_s = 0.0004\n"
        + "[noise]\ntx_stamp_ps = 5\nrx_stamp_ps = 150\nwhite_fm = 1e-11\nrandom_walk_fm = 1e-10\n"
        + "[accuracy]\nsurvey_std_m = 0\nrange_std_m = 6.5\nslope_std_m = 0.1\nplace_std_m = 0.2\n"
        + "place_distance_m = 650\nplace_time_s = 6000\n"
        + "[tags]\nheight_m = -1.5\n[floor_plan]\nimage = 'floor.png'\nwidth_m = 12\n"
        + "[georeference]\nlatitude_deg = -33.9\nlongitude_deg = 151\nheading_deg = -90\n"
        + "[[walls]]\nx1_m = 0\ny1_m = 0\nx2_m = 6\ny2_m = 0\n"
        + THREE
    )
    assert (site.schedule.slots, site.noise.rx_stamp_ps, site.tags.height_m) == (9, 150.0, -1.5)
    assert site.accuracy == AccuracySite(0.0, 6.5, 0.1, 0.2, 650.0, 6000.0)
    assert (site.floor_plan.width_m, site.georeference.longitude_deg, site.walls[0].loss_db) == (12.0, 151.0, 6.0)


@pytest.mark.parametrize(
    ("text", "key", "value", "right"),
    [
        (THREE, "name", None, "a text"),
        ('name = " "\nid = 1\nmaster = 1\n' + THREE, "name", " ", "at least one character"),
        (HEAD, "anchors", None, "[[anchors]]"),
        (HEAD + "anchors = 3\n", "anchors", 3, "[[anchors]]"),
        (HEAD + "anchors = []\n", "anchors", [], "at least one"),
        (HEAD + "anchors = [5]\n", "anchors[0]", 5, "[[anchors]]"),
        (HEAD + "tags = 1\n" + THREE, "tags", 1, "a [tags] table"),
        (HEAD.replace("id = 1", "id = true") + THREE, "id", True, "from 0 to 65533"),
        (HEAD.replace("id = 1", "id = 65535") + THREE, "id", 65535, "from 0 to 65533"),
        (HEAD.replace("master = 1", "master = 3") + THREE, "master", 3, "1, 2, 7"),
        (HEAD + THREE + "z = 1\n", "anchors[2].z (anchor 7)", 1, "z_m"),
        (HEAD + THREE + "colour = 1\n", "anchors[2].colour (anchor 7)", 1, "left out; the keys here are id, x_m"),
        (HEAD + "[schedul]\n" + THREE, "schedul", {}, "schedule"),
        (HEAD + "[schedule]\nslot = 1\n" + THREE, "schedule.slot", 1, "called slots or slot_s"),
        (HEAD + "[[anchors]]\nid = 4\nx_m = 1\n", "anchors[0].y_m (anchor 4)", None, "metres"),
        (HEAD + anchor(1, '"far"', 0), "anchors[0].x_m (anchor 1)", "far", "a number of metres"),
        (HEAD + anchor(1, 0, 1e7), "anchors[0].y_m (anchor 1)", 1e7, "from -1000000 to 1000000"),
        (HEAD + anchor(1, 10**400, 0), "anchors[0].x_m (anchor 1)", 10**400, "a number of metres"),
        (HEAD + anchor(-1, 0, 0), "anchors[0].id (anchor -1)", -1, "from 0 to 65533"),
        (HEAD + THREE + anchor(2, 1, 1), "anchors[3].id", 2, "anchors[1] has this one"),
        (HEAD + THREE + anchor(8, 6, 0), "anchors[3] (anchor 8)", "at (6.0, 0.0, 0.0)", "anchor 2 is at the same"),
        (HEAD + THREE + "slot = 3\n", "anchors[2].slot (anchor 7)", 3, "from 0 to 2"),
        (
            HEAD + anchor(1, 0, 0, slot=1) + anchor(2, 6, 0, slot=1),
            "anchors[1].slot (anchor 2)",
            1,
            "anchor 1 sends in slot 1",
        ),
        (
            HEAD + "[schedule]\nframes_per_node = 2\n" + anchor(1, 0, 0, slot=0) + anchor(2, 6, 0, slot=2),
            "anchors[1].slot (anchor 2)",
            2,
            "anchor 1 sends in slot 0",
        ),
        (
            HEAD + THREE + "rx_antenna_delay_ticks = 65536\n",
            "anchors[2].rx_antenna_delay_ticks (anchor 7)",
            65536,
            "65535",
        ),
        (HEAD + "[schedule]\nslots = 2\n" + THREE, "schedule.slots", 2, "at least 3 (3 anchors × 1 frames)"),
        (HEAD + "[schedule]\nslots = 256\n" + THREE, "schedule.slots", 256, "from 1 to 255"),
        (HEAD + "[schedule]\nframes_per_node = 86\n" + THREE, "schedule.frames_per_node", 86, "more than 255"),
        (
            HEAD + "[schedule]\nslots = 10\nframes_per_node = 3\n" + THREE + "slot = 5\n",
            "schedule.slots",
            10,
            "best a multiple of frames_per_node",
        ),
        (HEAD + "[schedule]\nslot_s = 0.0008\n" + THREE, "schedule.slot_s", 0.0008, "at least 0.000815"),
        (HEAD + "[schedule]\nguard_s = 0.0018\n" + THREE, "schedule.slot_s", 2**27 / 63.8976e9, "at least 0.002115"),
        (HEAD + "[schedule]\nslot_s = 0.06\nslots = 200\n" + THREE, "schedule.slot_s", 0.06, "below 0.04302"),
        (HEAD + "[noise]\nrx_stamp_ps = 0\n" + THREE, "noise.rx_stamp_ps", 0.0, "above 0"),
        (
            HEAD + "[georeference]\nlatitude_deg = 91\nlongitude_deg = 0\n" + THREE,
            "georeference.latitude_deg",
            91.0,
            "90",
        ),
        (HEAD + "[georeference]\nlatitude_deg = 1\n" + THREE, "georeference.longitude_deg", None, "from -180 to 180"),
        (HEAD + "[floor_plan]\nimage = 'no.png'\nwidth_m = 1\n" + THREE, "floor_plan.image", "no.png", "No such file"),
        (
            HEAD + "[floor_plan]\nimage = 'site.toml'\nwidth_m = 1\n" + THREE,
            "floor_plan.image",
            "site.toml",
            "PNG or JPEG",
        ),
        (HEAD + "[floor_plan]\nimage = '.'\nwidth_m = 1\n" + THREE, "floor_plan.image", ".", "a file that can be read"),
        (HEAD + '[floor_plan]\nimage = "a\\u0000"\nwidth_m = 1\n' + THREE, "floor_plan.image", "a\0", "be read"),
    ],
)
def test_a_mistake_is_named(refused, text, key, value, right):
    error = refused(text)
    assert (error.key, error.value) == (key, value)
    assert right in error.expected


LEAST_SLOT_S = air_time_s(MAX_FRAME_BYTES) + 0.0004


@pytest.mark.parametrize(
    "text",
    [
        THREE + anchor(8, 0.001, 0),
        "outline_m = [[0, 0], [0.001, 0], [9, 9]]\n" + THREE,
        "outline_m = [[0, 0], [0.002, 0], [0, 1]]\n" + THREE,
        "[schedule]\nframes_per_node = 85\n" + THREE,
        f"[schedule]\nguard_s = 0.0004\nslot_s = {LEAST_SLOT_S!r}\n" + THREE,
    ],
)
def test_exactly_at_a_limit_all_is_well(load, text):
    assert load(HEAD + text).name == "x"


def test_a_superframe_of_half_a_wrap_is_too_long(refused):
    slot_s = HALF_WRAP_S / 128
    error = refused(HEAD + f"[schedule]\nslots = 128\nslot_s = {slot_s!r}\n" + THREE)
    assert (error.key, error.value) == ("schedule.slot_s", slot_s)


@pytest.mark.parametrize(
    ("key", "value", "right"),
    [
        ("survey_std_m", -0.001, "a number of metres from 0 to 6.5"),
        ("survey_std_m", 6.6, "to 6.5"),
        ("range_std_m", -0.001, "from 0 to 6.5"),
        ("range_std_m", 20.0, "to 6.5"),
        ("slope_std_m", -0.001, "from 0 to 6.5"),
        ("slope_std_m", 6.51, "to 6.5"),
        ("place_std_m", -1.0, "from 0 to 6.5"),
        ("place_std_m", 7.0, "to 6.5"),
        ("place_distance_m", 0.0, "a number of metres above 0 and up to 650"),
        ("place_distance_m", 651.0, "up to 650"),
        ("place_time_s", 0.0, "a number of seconds above 0 and up to 6000"),
        ("place_time_s", 6001.0, "up to 6000"),
    ],
)
def test_limits_of_accuracy(refused, key, value, right):
    error = refused(HEAD + f"[accuracy]\n{key} = {value}\n" + THREE)
    assert (error.key, error.value) == (f"accuracy.{key}", value)
    assert right in error.expected


def test_accuracy_says_which_keys_it_has(refused):
    error = refused(HEAD + "[accuracy]\nsurvey_m = 0.1\n" + THREE)
    assert (error.key, error.expected) == ("accuracy.survey_m", "called survey_std_m")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name = \n", "line 1, column 8"),
        (HEAD + "id = 2\n", "line 4"),
        ("a = " + "[" * 5_000, "nests or counts too far"),
        ("id = " + "1" * 5_000, "nests or counts too far"),
        (".".join(["a"] * 100_000) + " = 1", "nests or counts too far"),
        (f"[{' . '.join(['a'] * 3_000)}]\nb = 1", "nests or counts too far"),
        ("anchors = " + "[" * 900 + "]" * 900, "should be"),
        (b"name = '\xff'\n", "UTF-8"),
    ],
)
def test_what_is_no_toml(refused, text, said):
    assert said in str(refused(text))


def test_files_that_are_not_there(tmp_path):
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(ConfigurationError, match=r"readable site file"):
            load_site(path)


@pytest.mark.parametrize(
    "key", [key for key in SITE_LIMITS if not key.startswith(("walls", "floors", "floor_plan", "georeference"))]
)
@pytest.mark.parametrize("number", ["nan", "inf", "-inf", "true", '"1"', "1979-05-27"])
def test_no_number_takes_what_is_none(refused, key, number):
    """Every numeric key of the template, given a value that is no finite number."""
    name = key.split(".")[-1]
    own = LAB if f"{name} = " in LAB else PAPER
    number = f"{{vans = {number}}}" if name == "group_silence_s" else number
    text, count = re.subn(rf"^(# )?({name} = )(\{{.*?\}}|[^ \n]+)", rf"\g<2>{number}", own, count=1, flags=re.MULTILINE)
    if key in ("anchors.id", "anchors.slot") or count == 0 or "antenna_delay" in key:
        text = LAB.replace("[[anchors]]\nid = 1", f"[[anchors]]\nid = 1\n{name} = {number}").replace("id = 1\nid", "id")
    error = refused(text)
    assert re.sub(r"\[\d+\]| \(anchor.*", "", error.key) == key


@given(st.text(max_size=80) | st.binary(max_size=80))
def test_no_file_ends_in_anything_but_a_configuration_error(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))
    with pytest.raises(ConfigurationError):
        load_site(path)


TOML_VALUES = [
    "0", "-1", "1", "70000", "1.5", "nan", "inf", "1e300", '""', '"x"', "true", "[]", "{}", "[[1]]", "10:00:00", "[{}]",
]  # fmt: skip


@given(st.integers(0, 200), st.sampled_from(TOML_VALUES))
def test_one_changed_value_is_accepted_or_named(tmp_path_factory, line, value):
    lines = LAB.replace("# slot = 0", "").splitlines()
    keys = [number for number, text in enumerate(lines) if re.match(r"\w+ = ", text)]
    number = keys[line % len(keys)]
    key = lines[number].split(" = ")[0]
    lines[number] = f"{key} = {value}"
    path = tmp_path_factory.getbasetemp() / "changed.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    try:
        site = load_site(path)
    except ConfigurationError as error:
        assert error.key
        assert error.expected
    else:
        assert isinstance(msgspec.to_builtins(site), dict)


def test_messages_are_short():
    error = ConfigurationError("a.toml", "name", "x" * 10_000, "shorter")
    assert len(str(error)) < 150
    assert str(ConfigurationError("a.toml", "on", True, "off")) == "a.toml: on is true; it should be off"
