"""Lists of assets: what is valid, and tables as spreadsheets write them."""

import re
import string

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from skyless.run.assets import COLUMNS, MAX_ASSETS, assets_at, check_assets, read_csv, write_csv
from skyless.run.mqtt.messages import Asset, AssetsMessage, WrongMessageError

TAGS = st.text(string.ascii_letters + string.digits + "_.-", min_size=1, max_size=64)
TEXTS = st.text(st.characters(categories=["L", "N", "P", "S"]), max_size=8)
ASSETS = st.builds(
    Asset,
    tag=TAGS,
    name=TEXTS,
    group=TEXTS,
    icon=TEXTS,
    colour=st.from_regex(r"(#[0-9a-fA-F]{6})?", fullmatch=True),
    owner=TEXTS,
    notes=TEXTS,
)
LISTS = st.lists(ASSETS, max_size=8, unique_by=lambda asset: asset.tag).map(tuple)


@pytest.mark.site
@given(LISTS)
def test_a_table_gives_what_was_written(assets):
    check_assets(assets)
    assert read_csv(write_csv(assets)) == assets


@pytest.mark.parametrize("name", ["=cmd|'/C calc'!A1", "+1", "-2", "@x", "'", "'=x"])
def test_no_cell_is_a_formula(name):
    written = write_csv((Asset("t1", name=name),))
    assert written.decode().splitlines()[1].split(",")[1].strip('"') == f"'{name}"
    assert read_csv(written) == (Asset("t1", name=name),)


@pytest.mark.site
@given(LISTS, st.sampled_from([",", ";", "\t"]), st.sampled_from(["", "\ufeff"]), st.sampled_from(["\n", "\r\n"]))
def test_tables_of_other_programs_are_read(assets, delimiter, mark, end):
    assume(not any(re.match("'[=+@'-]", getattr(asset, name)) for asset in assets for name in COLUMNS))
    quoted = [[f'"{getattr(asset, name).replace(chr(34), chr(34) * 2)}"' for name in COLUMNS] for asset in assets]
    lines = [delimiter.join(COLUMNS), *(delimiter.join(row) for row in quoted)]
    assert read_csv((mark + end.join(lines) + end).encode()) == assets


def test_columns_in_another_order_and_empty_lines():
    table = "Group;TAG\nforklifts;t1\n\n;\n;t2\n"
    assert read_csv(table.encode()) == (Asset("t1", group="forklifts"), Asset("t2"))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (b"", ("line 1", "no column tag")),
        (b"name,group\na,b\n", ("line 1", "no column tag")),
        (b"tag,size\nt1,2\n", ("line 1", "'size'", "owner")),
        (b"tag,tag\nt1,t2\n", ("line 1", "each once")),
        (b"tag,name\nt1,a\nt2\n", ("line 3", "1 cells", "2")),
        (b"tag\nt1\nt1\n", ("line 3", "'t1'", "line 2")),
        (b"tag,colour\nt1,red\n", ("line 2", "colour", "'red'", "#rrggbb")),
        (b'tag,notes\nt1,"a\nb"\nt 2,x\n', ("line 4", "tag", "'t 2'", "letters")),
        (b"tag,name\nt1,\xff\n", ("line 2", "UTF-8")),
        (b'tag,name\nt1,"a"b\n', ("line 2", "CSV")),
        (b"tag,name\nt1,\x00\n", ("line 2",)),
        (b"tag,name\nt1," + b"x" * 101, ("line 2", "name", "100")),
        (b"x" * 4_000_001, ("4000001 bytes",)),
    ],
)
def test_a_wrong_table_names_its_line(table, words):
    with pytest.raises(WrongMessageError) as caught:
        read_csv(table)
    assert all(word in str(caught.value) for word in words), caught.value


@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_any_bytes_are_a_table_or_refused(data):
    try:
        check_assets(read_csv(data))
    except WrongMessageError as error:
        assert str(error)


def test_limits():
    check_assets(tuple(Asset(f"t{n}") for n in range(MAX_ASSETS)))
    for assets, words in (
        (tuple(Asset(f"t{n}") for n in range(MAX_ASSETS + 1)), "10000"),
        ((Asset("t1"), Asset("t1")), "two assets"),
        ((Asset("t1", colour="#12345"),), "asset 't1': colour is '#12345'; it should be #rrggbb"),
        (tuple(Asset(f"t{n}", notes="x" * 900) for n in range(5000)), "shorten the notes"),
    ):
        with pytest.raises(WrongMessageError, match=words):
            check_assets(assets)


def test_another_sites_assets_are_not_shown():
    message = AssetsMessage((Asset("t1"),), "hall")
    assert assets_at(message, "hall") == {"t1": Asset("t1")}
    assert assets_at(message, "shed") == {}
    assert assets_at(AssetsMessage((Asset("t1"),)), "shed") == {"t1": Asset("t1")}
