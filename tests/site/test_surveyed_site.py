"""A survey's result in a site and in the text of its file, and the record next to it."""

import json
import re

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.air.site_pages import site_issue
from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.pages import site_pages_of
from skyless.core.site import EXACT, AccuracySite, ScheduleSite, UnplacedAnchor
from skyless.core.ticks import TICK_M
from skyless.sim.lab import paper_lab_site
from skyless.site.file.check import check_site
from skyless.site.file.load import load_site
from skyless.site.file.template import site_template
from skyless.site.survey import surveyed_site as surveyed
from skyless.site.survey.facts import PairRange, PairRanges, Survey, SurveyedAnchor

pytestmark = pytest.mark.site

LAB = paper_lab_site(accuracy=AccuracySite())


def survey_of(*anchors, range_std_m=0.03):
    return Survey(anchors, (), range_std_m, 3, None, (), (), (), "the frame", None, ())


def found(identifier, x_m=1.0, y_m=2.0, z_m=0.5, std_m=0.0123, delay_m=0.1):
    return SurveyedAnchor(identifier, True, x_m, y_m, z_m, std_m, None, delay_m, 0.01)


def free_site(placed, unplaced):
    """A site of protocol 2."""
    anchors, others = LAB.anchors[:placed], tuple(UnplacedAnchor(100 + k) for k in range(unplaced))
    schedule = ScheduleSite(mode="free")
    return replace(LAB, anchors=anchors, unplaced=others, schedule=schedule, master=(*anchors, *others)[0].id)


coordinates = st.floats(-900.0, 900.0)
anchors_found = st.builds(
    lambda x, y, z, std, delay, determined: (
        found(0, x, y, z, std, delay) if determined else SurveyedAnchor(0, False, reason="no range")
    ),
    coordinates,
    coordinates,
    coordinates,
    st.floats(0.0, 0.25),
    st.floats(-1.0, 1.0),
    st.booleans(),
)


@given(
    st.sampled_from([LAB, replace(LAB, accuracy=EXACT), free_site(4, 2), free_site(0, 5), free_site(6, 0)]),
    st.lists(anchors_found, min_size=6, max_size=6),
    st.floats(0.0, 0.2),
)
def test_the_written_text_is_the_surveyed_site(tmp_path_factory, site, anchors, range_std_m):
    everybody = site.all_anchors
    survey = survey_of(
        *(replace(one, id=anchor.id) for one, anchor in zip(anchors, everybody, strict=False)), range_std_m=range_std_m
    )
    path = tmp_path_factory.mktemp("site") / "site.toml"
    path.write_text(site_template(site))
    assert load_site(path) == site
    before = path.read_text()
    try:
        after = surveyed.surveyed_text(before, survey, site, path)
    except ConfigurationError as error:  # two anchors at one point, as hypothesis likes them
        assert "anchors" in error.key
        return
    path.write_text(after)
    written, expected = load_site(path), surveyed.surveyed_site(site, survey)
    order = lambda anchors: sorted(anchors, key=lambda anchor: anchor.id)  # noqa: E731
    assert order(written.anchors) == order(expected.anchors)
    assert written.unplaced == expected.unplaced
    assert replace(written, anchors=(), unplaced=()) == replace(expected, anchors=(), unplaced=())
    assert re.findall("#.*", after) == re.findall("#.*", before)


def test_comments_and_layout_stay_and_only_what_has_changed_is_written(tmp_path):
    text = site_template(LAB).replace("[[anchors]]\n", "[[anchors]]   # by the door\n", 1)
    first = LAB.anchors[0]
    survey = survey_of(found(first.id, first.x_m, 1.25, first.z_m, delay_m=0.0))
    after = surveyed.surveyed_text(text, survey, LAB, tmp_path / "lab.toml")
    changed = [(old, new) for old, new in zip(text.splitlines(), after.splitlines(), strict=True) if old != new]
    assert [new.split("#")[0].strip() for _, new in changed] == ["survey_std_m = 0.019", "y_m = 1.25"]


def test_delays_accuracy_and_anchors_that_are_not_determined():
    site = free_site(2, 2)
    a, b = site.anchors
    kept = site.unplaced[1]
    survey = survey_of(
        found(a.id, delay_m=-0.2, std_m=0.00421),
        found(100, 3.00004, -0.00001, 2.5, std_m=0.9, delay_m=0.2),
        SurveyedAnchor(b.id, False, reason="hangs on one range"),
        found(999),
        range_std_m=0.05432,
    )
    new = surveyed.surveyed_site(site, survey)
    assert new.anchors[0].tx_antenna_delay_ticks - a.tx_antenna_delay_ticks == round(-0.4 / TICK_M)
    assert new.anchors[0].std_m == 0.005
    assert new.anchors[1] == b
    assert (new.anchors[2].x_m, new.anchors[2].y_m, new.anchors[2].z_m) == (3.0, 0.0, 2.5)
    assert (new.anchors[2].id, new.anchors[2].std_m) == (site.unplaced[0].id, 0.255)
    assert new.unplaced == (kept,)
    assert new.accuracy == replace(site.accuracy, range_std_m=0.0544)
    assert surveyed.delay_changes_ticks(site, survey) == {a.id: round(-0.4 / TICK_M), 100: round(0.4 / TICK_M)}


@pytest.mark.parametrize("range_std_m", [0.0, 0.03, 0.50003, 6.5])
def test_tags_see_from_the_accuracy_that_delays_have_changed(range_std_m):
    """Positions that are kept do not change the almanac, and delays are not in it."""
    site = replace(free_site(6, 0), accuracy=replace(LAB.accuracy, range_std_m=range_std_m))
    kept = [found(one.id, one.x_m, one.y_m, one.z_m, one.std_m, 0.0) for one in site.anchors]
    assert surveyed.surveyed_site(site, survey_of(*kept, range_std_m=0.0)).accuracy == site.accuracy
    changed = surveyed.surveyed_site(site, survey_of(*kept[1:], replace(kept[0], delay_m=0.1), range_std_m=0.0))
    assert 0.5e-4 < abs(changed.accuracy.range_std_m - range_std_m) < 2e-4
    assert site_issue(site_pages_of(changed)) != site_issue(site_pages_of(site))
    check_site(changed, "the site")


def test_one_accuracy_for_all_anchors_in_protocol_1():
    site = replace(LAB, accuracy=replace(LAB.accuracy, survey_std_m=0.02, range_std_m=0.1))
    first, second = LAB.anchors[:2]
    new = surveyed.surveyed_site(site, survey_of(found(first.id, std_m=0.01), found(second.id, std_m=0.0)))
    assert new.accuracy == replace(site.accuracy, survey_std_m=0.0169)  # sqrt((0.01² + 4 · 0.02²) / 6), rounded up
    assert surveyed.surveyed_site(site, survey_of()) == site


def test_an_antenna_delay_that_no_radio_has(tmp_path):
    with pytest.raises(SkylessError, match="antenna delay of -"):
        surveyed.surveyed_text(
            site_template(LAB), survey_of(found(LAB.anchors[0].id, delay_m=-50.0)), LAB, tmp_path / "a.toml"
        )


def test_sections_that_the_file_lacks_are_added(tmp_path):
    path = tmp_path / "small.toml"
    text = 'name = "a"\nid = 1\nmaster = 1\n' + "".join(
        f"[[anchors]]\nid = {k}\nx_m = {k}\ny_m = 0\n" for k in (1, 2, 3)
    )
    path.write_text(text.removesuffix("\n"))
    site = load_site(path)
    survey = survey_of(*(found(k, 2.0 * k, std_m=0.001) for k in (1, 2, 3)), range_std_m=0.5)
    path.write_text(surveyed.surveyed_text(path.read_text(), survey, site, path))
    assert load_site(path) == surveyed.surveyed_site(site, survey)


RANGES = PairRanges((PairRange(1, 2, 5.0, 0.001, 9), PairRange(1, 3, 4.0, 0.001, 9)), (1, 2, 3), {1: 0.001}, 4.0)


def test_the_record_comes_back_and_its_baseline_has_the_new_delays(tmp_path):
    path = surveyed.record_path(tmp_path / "hall.toml")
    assert path.name == "hall.survey.json"
    record = surveyed.SurveyRecord("hall", 7, 1.75e9, RANGES, survey_of(found(1), found(2)), {1: 20, 2: -4})
    path.write_bytes(surveyed.encode_record(record))
    assert surveyed.read_record(path) == record
    assert [pair.range_m for pair in surveyed.baseline(record).pairs] == pytest.approx(
        [5.0 - 8 * TICK_M, 4.0 - 10 * TICK_M]
    )


@pytest.mark.parametrize(
    "data", [b"", b"[]", b"{}", b'{"format":"skyless survey 9"}', b'{"format":"skyless survey 1","site":3}', b"\xff"]
)
def test_a_bad_record_is_refused(tmp_path, data):
    path = tmp_path / "x.survey.json"
    path.write_bytes(data)
    with pytest.raises(ConfigurationError, match=r"x\.survey\.json"):
        surveyed.read_record(path)
    with pytest.raises(ConfigurationError, match="can be read"):
        surveyed.read_record(tmp_path / "none.json")


def test_json_has_no_infinity():
    """Whatever a survey holds comes back from JSON: on MQTT, too."""
    survey = survey_of(found(1))
    assert msgspec.json.decode(msgspec.json.encode(survey), type=Survey) == survey
    assert "null" not in json.dumps(msgspec.to_builtins(RANGES))
