"""Packing without a server: numbers, order, and what is dropped and counted."""

from gathered_fixes import payload
from hypothesis import given
from hypothesis import strategies as st

from skyless.run.fix_batch import MAX_RECORDS
from skyless.run.gather import node as packer_module
from skyless.run.gather import subjects
from skyless.run.gather.node import Packer


def batches(packer, numbers):
    found = []
    while tags := packer.next_tags():
        assert packer.next_tags() == tags
        batch = packer.next_batch(numbers, 9, 2000.0)
        if batch is not None:
            found.append(batch)
    assert packer.waiting == 0
    return found


@given(st.lists(st.sampled_from("abcdefgh"), max_size=2500), st.sets(st.sampled_from("abcdefgh")))
def test_every_fix_of_a_tag_with_a_number_is_packed_once_in_order(tags, known):
    numbers, packer = {tag: 3 * n + 1 for n, tag in enumerate(sorted(known))}, Packer(77)
    for x, tag in enumerate(tags):
        packer.add(tag, payload(tag, x / 1000.0))
    assert packer.waiting == packer.fixes == len(tags)
    ready = batches(packer, numbers)
    records = [record for batch in ready for record in batch.records]
    assert [record["position_mm"][0] for record in records] == [x for x, tag in enumerate(tags) if tag in known]
    assert [record["tag"] for record in records] == [numbers[tag] for tag in tags if tag in known]
    assert packer.drops["no-number"] == len(tags) - len(records)
    assert [batch.id for batch in ready] == [f"77-{n + 1}" for n in range(len(ready))]
    assert all(len(batch.records) <= MAX_RECORDS for batch in ready)


@given(st.binary(max_size=60) | st.just(payload("other")) | st.just(payload("t").replace(b"2.0", b'"x"')))
def test_what_cannot_be_read_or_is_of_another_tag_is_counted(data):
    packer = Packer(1)
    packer.add("t", data)
    assert packer.drops == {"wrong": 1}
    assert packer.waiting == 0


def test_beyond_its_room_the_oldest_fixes_are_dropped_and_counted(monkeypatch):
    monkeypatch.setattr(packer_module, "MAX_WAITING", 5)
    packer = Packer(1)
    for x in range(8):
        packer.add("t", payload("t", float(x)))
    (batch,) = batches(packer, {"t": 1})
    assert batch.records["position_mm"][:, 0].tolist() == [3000, 4000, 5000, 6000, 7000]
    assert packer.drops == {"late": 3}


def test_subjects():
    assert subjects.at(subjects.FIXES, 7, "hall") == "skyless.v2.7.fixes.hall"
    assert subjects.at(subjects.FIXES, 7) == "skyless.v2.7.fixes.*"
    assert subjects.at(subjects.NAMES, 7, 12) == "skyless.v2.7.names.12"
    assert subjects.tag_in("skyless.v1.7.tag.a//b.fix") == "a.b"
    assert (subjects.site_in("skyless.v1.7.site"), subjects.site_in("skyless.v1.x.site")) == (7, None)
