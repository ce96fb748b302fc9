"""Packing without a server: numbers, order, and what is dropped and counted."""

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from skyless.run.fix_batch import MAX_RECORDS, PackedFix, decode_batch
from skyless.run.gather import packer as packer_module
from skyless.run.gather import subjects
from skyless.run.gather.packer import NamesTable, Packer, TagName


def payload(tag, x_m=1.0):
    fix = PackedFix(tag, 1000.0, (x_m, 2.0, 3.0), (1e-4,) * 9, None, (1, 2, 3), height_known=True)
    return msgspec.json.encode(fix)


def batches(packer, names):
    found = []
    while packer.waiting:
        packer.give_numbers(names, 2000.0)
        batch = packer.next_batch(names, 2000.0)
        if batch is not None:
            found.append(batch)
    return found


@given(st.lists(st.sampled_from("abcdefgh"), max_size=2500), st.sets(st.sampled_from("abcdxyz")))
def test_every_fix_is_packed_once_in_order_under_the_number_of_its_name(tags, known):
    before = {3 * n + 1: TagName(name, "h", 1.0) for n, name in enumerate(sorted(known))}
    names, packer = NamesTable(before), Packer(77, "here")
    for x, tag in enumerate(tags):
        packer.add(tag, payload(tag, x / 1000.0))
    ready = batches(packer, names)
    records = [record for one in ready for record in decode_batch(one.data).records]
    assert [record["position_mm"][0] for record in records] == list(range(len(tags)))
    assert [record["tag"] for record in records] == [names.numbers[tag] for tag in tags]
    assert [one.id for one in ready] == [f"77-{n + 1}" for n in range(len(ready))]
    assert all(one.fixes <= MAX_RECORDS for one in ready)
    assert all(names.numbers[tag.name] == number for number, tag in before.items())
    assert len(set(names.numbers.values())) == len(names.numbers)
    new = set(tags) - known
    assert sorted(tag.name for tag in names.unsaved.values()) == sorted(new)
    assert min(names.unsaved, default=10**6) > max(before, default=0)


@given(
    st.binary(max_size=60)
    | st.just(payload("other"))
    | st.just(payload("t").replace(b'"height', b'"alert":"x","height'))
)
def test_what_cannot_be_read_or_is_of_another_tag_is_counted(data):
    packer = Packer(1, "here")
    packer.add("t", data)
    assert packer.drops == {"wrong": 1}
    assert packer.next_batch(NamesTable({}), 1.0) is None


def test_beyond_its_room_the_oldest_fixes_are_dropped_and_counted(monkeypatch):
    monkeypatch.setattr(packer_module, "MAX_WAITING", 5)
    packer = Packer(1, "here")
    for x in range(8):
        packer.add("t", payload("t", float(x)))
    (batch,) = batches(packer, NamesTable({}))
    assert decode_batch(batch.data).records["position_mm"][:, 0].tolist() == [3000, 4000, 5000, 6000, 7000]
    assert packer.drops == {"late": 3}


def test_a_full_table_of_names_drops_fixes_of_new_tags_only(monkeypatch):
    monkeypatch.setattr(packer_module, "MAX_NAMES", 2)
    packer, names = Packer(1, "here"), NamesTable({})
    for tag in "abcab":
        packer.add(tag, payload(tag))
    assert sum(one.fixes for one in batches(packer, names)) == 4
    assert packer.drops == {"no-number": 1}


def test_subjects():
    assert subjects.at(subjects.FIXES, 7, "hall") == "skyless.v2.7.fixes.hall"
    assert subjects.at(subjects.FIXES, 7) == "skyless.v2.7.fixes.>"
    assert subjects.at(subjects.NAMES, 7, 12) == "skyless.v2.7.names.12"
    assert subjects.tag_in("skyless.v1.7.tag.a//b.fix") == "a.b"
    assert (subjects.site_in("skyless.v1.7.site"), subjects.site_in("skyless.v1.x.site")) == (7, None)
