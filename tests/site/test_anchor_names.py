"""Names of anchors: MAC addresses of FiRa's systems have one spelling, which tables and options take as well."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.cli.main import main
from skyless.core.errors import ConfigurationError
from skyless.core.site import AnchorSite, Site
from skyless.run.site_table import SiteTable
from skyless.site.anchor_names import anchor_name, read_anchor
from skyless.site.survey.anchor_errors import DifferenceCalibration
from skyless.site.tables import new_table, read_anchors
from support import synthetic_recordings as synthetic

short = st.integers(0, 0xFFFF)
anchors = short | st.integers(0x10000, 2**64 - 1)


@given(short | anchors)
def test_every_spelling_of_an_anchor_is_read(anchor):
    address = anchor_name(anchor, addresses=True)
    assert (address, anchor_name(anchor, addresses=False)) == (f"{anchor:0{4 if anchor < 2**16 else 16}X}", str(anchor))
    for text in (address, address.lower()):
        assert read_anchor(text, addresses=True) == anchor
        assert read_anchor(text) == (int(text) if text.isdecimal() else anchor)
    assert read_anchor(f"0x{address}") == read_anchor(f"{anchor:#x}") == anchor


@pytest.mark.parametrize("text", ["", "C97", "C974C", "-1", "0x-1", "x", "C974-0364"])
def test_other_texts_are_no_anchors(text, tmp_path):
    table = tmp_path / "anchors.csv"
    table.write_text(f"id,x_m,y_m,z_m\n{text},0,0,1\n")
    with pytest.raises(ConfigurationError, match="a whole number, one after 0x, or a MAC address, as C974"):
        read_anchors(table)


@given(st.lists(anchors, min_size=1, unique=True), st.booleans())
def test_a_table_that_is_written_is_read_again(tmp_path_factory, anchors, addresses):
    places = {anchor: (float(number), 0.0, 2.0) for number, anchor in enumerate(anchors)}
    table = tmp_path_factory.getbasetemp() / "anchors.csv"
    table.write_text(new_table(places, DifferenceCalibration({}), addresses=addresses))
    assert read_anchors(table) == places


def test_a_spreadsheet_may_leave_out_zeros(tmp_path):
    table = tmp_path / "anchors.csv"
    table.write_text("id,x_m,y_m,z_m\nC974,0,0,1\n364,1,0,1\n")
    assert list(read_anchors(table)) == [0xC974, 0x364]


def test_offline_anchors_are_named_as_they_are_called():
    site = Site("hall", 1, 7, tuple(AnchorSite(anchor, x, 0.0) for x, anchor in enumerate((0xC974, 7))))
    for addresses, names in ((False, ["51572", "7"]), (True, ["C974", "0007"])):
        table = SiteTable(0.0)
        table.set_site(site, 0.0, addresses=addresses)
        assert table.spelled(table.site_anchors) == names


@pytest.mark.site
def test_reports_and_tables_of_a_phone_name_its_anchors_alike(tmp_path, capsys, complaint):
    recording, table, fixes = tmp_path / "phone.jsonl", tmp_path / "anchors.csv", tmp_path / "fixes.csv"
    records = [json.loads(line) for line in synthetic.phone_records(900, speed_mps=0.0)]
    for record in records:
        record["address"] = f"C97{record['address'][-1]}"
    recording.write_text("".join(json.dumps(record) + "\n" for record in records))
    at = ",".join(map(str, synthetic.place_m(0.0, 0.0)))
    assert main(["calibrate", str(recording), "--at", at, "--out", str(table)]) == 0
    assert "anchor C971" in capsys.readouterr().out
    assert [line.split(",")[0] for line in table.read_text().splitlines()[1:]] == [f"C97{n}" for n in range(1, 9)]
    assert main(["replay", str(recording), "--anchors", str(table), "--fixes-csv", str(fixes), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["drops"] == {}
    assert set(fixes.read_text().splitlines()[-1].split(",")[14].split()) <= {f"C97{n}" for n in range(1, 9)}
    assert "positions are those that messages state" in complaint("survey", "--recording", recording)
