"""Receivers as bytes and back: the same bits afterwards, and nothing that a hostile recording could do."""

import contextlib
import pickle
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import astuple, replace
from numpy.lib.recfunctions import repack_fields

from machines.bench import LAB, PAIRS, ROOM, tape
from skyless.core.air.frame import Reception
from skyless.core.air.site_pages import encode_page
from skyless.core.any_receiver import AnyReceiver
from skyless.core.estimator.state import Anchor, KeptPacket, Link, Status
from skyless.core.method_names import METHODS
from skyless.core.native.records import PACKETS_KEPT, packed, unpacked
from skyless.core.protocol1.beacon import decode, encode
from skyless.core.tag.admission import Admission, Tag
from skyless.core.tag.following import Course
from skyless.core.ticks import Unwrapper
from skyless.run.recordings.reception_log import RefusedError, load, save

pytestmark = pytest.mark.site

RNG = np.random.default_rng(20)


def bits(fix):
    """All of a fix, to the bit."""
    parts = () if fix is None else astuple(fix)
    return [part.tobytes() if isinstance(part, np.ndarray) else part for part in parts]


@pytest.mark.parametrize("site", [LAB, ROOM, PAIRS], ids=["lab", "room", "pairs"])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.statistical
def test_a_receiver_goes_on_with_the_same_bits(method, site):
    heard = [one.reception for one in tape(site, 2.5)]
    cuts = set(RNG.choice(len(heard), 25, replace=False)) | {0, 1}
    straight, cut = AnyReceiver(method), AnyReceiver(method)
    fixes = 0
    for number, reception in enumerate(heard):
        if number in cuts:
            cut = load(save(cut))
        expected = straight.hear(reception)
        assert bits(cut.hear(reception)) == bits(expected)
        assert cut.reason == straight.reason
        fixes += expected is not None
    assert fixes > 50
    assert cut.counters == straight.counters
    assert save(load(save(cut))) == save(cut)


def test_a_receiver_in_trouble_goes_on_with_the_same_bits():
    heard = [one.reception for one in tape(LAB, 2.5)]
    rng = np.random.default_rng(3)
    noisy = [reception for reception in heard for _ in range(1 + (rng.random() < 0.05))]
    noisy = [
        Reception(r.frame, int(r.rx_ticks + rng.integers(0, 1 << 20)) % (1 << 40)) if rng.random() < 0.1 else r
        for r in noisy
    ]
    straight, cut = AnyReceiver(), AnyReceiver()
    for number, reception in enumerate(noisy):
        if number % 11 == 0:
            cut = load(save(cut))
        assert bits(cut.hear(reception)) == bits(straight.hear(reception))
    assert straight.counters["outlier"] > 0
    assert cut.counters == straight.counters


def test_a_receiver_that_has_heard_of_another_master_goes_on_with_the_same_bits():
    heard = [one.reception for one in tape(LAB, 2.5)]
    half = len(heard) // 2
    heard[half:] = [replace(r, frame=encode(replace(decode(r.frame), term=1))) for r in heard[half:]]
    straight, cut = AnyReceiver(), AnyReceiver()
    fixes = 0
    for number, reception in enumerate(heard):
        if number % 11 == 0 or half <= number < half + 12:
            cut = load(save(cut))
        expected = straight.hear(reception)
        assert bits(cut.hear(reception)) == bits(expected)
        fixes += expected is not None and number > half + 12
    assert fixes > 50
    assert cut.counters == straight.counters


class Bomb:
    def __reduce__(self):
        return (Path.touch, (Path("/tmp/skyless-was-here"),))


def refusal(state):
    with pytest.raises(RefusedError) as caught:
        load(state)
    return caught.value.reason


def test_pickles_are_not_executed():
    assert refusal(pickle.dumps(Bomb())) == "checkpoint-damaged"
    assert not Path("/tmp/skyless-was-here").exists()


def test_another_version_is_refused():
    envelope = msgspec.msgpack.decode(save(AnyReceiver()))
    for change in ({"version": "0.0.1"}, {"format": 1}):
        assert refusal(msgspec.msgpack.encode(envelope | change)) == "checkpoint-of-another-version"


def changed(state, path, value):
    """The same checkpoint with another value at a path of keys; what ``value`` makes of it if that is a function."""
    checkpoint = msgspec.msgpack.decode(state, strict=False)
    *way, last = path
    inner = checkpoint["receiver"]["receiver"]
    if path[0] in inner["admission"]:
        inner = inner["admission"]
    for key in way:
        inner = inner[key]
    inner[last] = value(inner[last]) if callable(value) else value
    return msgspec.msgpack.encode(checkpoint)


def with_record(made, change):
    """What changes a record that is kept as bytes."""

    def changed_bytes(data):
        one = unpacked(made, data)
        change(one)
        return packed(one)

    return changed_bytes


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (["only_site"], "1"),
        (["admitted"], "x"),
        (["admitted"], with_record(Admission, lambda one: setattr(one.neighbours, "count", 1 << 20))),
        (["admitted"], with_record(Admission, lambda one: setattr(one.neighbours, "row", 256))),
        (["admitted"], with_record(Admission, lambda one: setattr(one.choice, "count", 9))),
        (["admitted"], with_record(Admission, lambda one: setattr(one.choice, "failed_count", -1))),
        (["admitted"], with_record(Admission, lambda one: setattr(one.choice.sites[2], "count", 33))),
        (["admitted"], with_record(Admission, lambda one: setattr(one.own, "bits", 63))),
        (["admitted"], lambda data: data[:-1]),
        (["admitted"], lambda data: data + b"x"),
        (["admitted"], lambda _: packed(Unwrapper())),
        (["options", "method"], "tracker"),
        (["options", "integrity", "risk"], 0.5),
        (["reason"], "bored"),
        (["counters"], [1]),
        (["almanac", "pages"], lambda pages: [*pages, b"too short"]),
        (["almanac", "pages"], lambda pages: [*pages, bytes(17)]),
        (["almanac", "unconfirmed"], [b"\x02" + bytes(16)]),
        (["almanac", "pages"], []),
        (["has_method_key"], False),
        (["method"], None),
        (["method"], {"type": "snapshots", "round": None, "previous": {}, "current": {}}),
        (["method", "type"], "skyless.cli.main"),
        (["method", "estimator", "anchors"], lambda table: [*table[:-1], table[0]]),
        (["method", "estimator", "anchors"], lambda table: table + [[k, 0.0, 0.0, 0.0] for k in range(300, 5000)]),
        (["method", "estimator", "anchors", 0], lambda row: row[:3]),
        (["method", "course"], with_record(Course, lambda one: setattr(one, "count", 33))),
        (["method", "course"], "x"),
        (["master_scale", "points", 0], [1, 2]),
    ],
)
def test_states_of_other_things_are_refused(path, value):
    state = save(joint_receiver())
    load(changed(state, path, lambda same: same))
    assert refusal(changed(state, path, value)) == "checkpoint-damaged"


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (["tag"], with_record(Tag, lambda one: setattr(one.admission.neighbours, "count", 257))),
        (["tag"], with_record(Tag, lambda one: setattr(one.pages, "count", -1))),
        (["tag"], with_record(Tag, lambda one: setattr(one.pages, "issue", -1))),
        (["tag"], with_record(Tag, lambda one: setattr(one.pages.used[0], "contents", (3, 255, 255, 255, 255)))),
        (["tag"], with_record(Tag, lambda one: setattr(one.pages.collected[5], "sender_count", 17))),
    ],
)
def test_states_of_other_things_are_refused_at_random_instants(path, value):
    receiver = AnyReceiver()
    for one in tape(replace(LAB, schedule=replace(LAB.schedule, mode="free", rate_hz=60.0)), 1.0):
        receiver.hear(one.reception)
    state = save(receiver)
    load(changed(state, path, lambda same: same))
    assert refusal(changed(state, path, value)) == "checkpoint-damaged"


@lru_cache
def saved_states():
    heard = [one.reception for one in tape(LAB, 1.0)]
    states = []
    for method, count in (("joint", 0), ("joint", 20), ("joint", 300), ("bracketed", 300)):
        receiver = AnyReceiver(method)
        for reception in heard[:count]:
            receiver.hear(reception)
        states.append(save(receiver))
    return states


@given(st.data())
@settings(max_examples=300, deadline=None)
def test_damaged_bytes_are_refused_or_harmless(data):
    state = bytearray(data.draw(st.sampled_from(saved_states())))
    for _ in range(data.draw(st.integers(1, 4))):
        state[data.draw(st.integers(0, len(state) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(state[: data.draw(st.integers(0, len(state)))])
    for damaged in (bytes(state), cut):
        try:
            receiver = load(damaged)
        except RefusedError as error:
            assert error.reason.startswith("checkpoint-")
        else:
            assert type(receiver) is AnyReceiver
            with contextlib.suppress(Exception):  # a replay counts whatever fails
                for one in tape(LAB, 1.0)[300:310]:
                    receiver.hear(one.reception)


STATE = ("method", "estimator", "state")


def with_byte(place, value):
    """What sets one byte."""
    return lambda data: data[:place] + bytes([value]) + data[place + 1 :]


def with_field(dtype, begin, name, value, size=None):
    """What sets a field of a record that begins at a place, as ``packed_state`` writes it."""

    def change(data):
        packed = repack_fields(np.empty(0, dtype), recurse=True).dtype
        kind, offset = packed.fields[name]
        at = begin(data) + offset
        return data[:at] + np.array(value, kind).tobytes() + data[at + kind.itemsize :]

    return change


def third_anchor(data):
    """Where the third anchor's record begins: behind it are records of all others, of packets and of links."""
    count = data[3]
    kinds = (np.empty(0, np.dtype(one)) for one in (Anchor, KeptPacket, Link))
    sizes = [repack_fields(kind, recurse=True).dtype.itemsize for kind in kinds]
    behind = count * (sizes[0] + PACKETS_KEPT * sizes[1] + count * sizes[2])
    return len(data) - behind + 2 * sizes[0]


@pytest.mark.parametrize(
    "change",
    [
        lambda data: data[:-8],
        lambda data: data + bytes(8),
        lambda _: b"",
        lambda data: data * 2,
        lambda _: 0,
        with_byte(0, 77),
        with_byte(2, 3),
        with_byte(3, 5),
        with_byte(3, 0),
        with_byte(3, 255),
        with_byte(4, 1),
        with_field(np.dtype(Anchor), third_anchor, "identifier", 1),
        with_field(np.dtype(Status), lambda _: 5, "range_errors", -1),
        with_field(np.dtype(Status), lambda _: 5, "range_errors", 3),
    ],
    ids=[
        "short", "long", "none", "twice", "number", "version", "dimensions", "fewer anchors", "no anchors",
        "all anchors", "phases", "an anchor twice", "range errors -1", "range errors 3",
    ],
)  # fmt: skip
def test_states_that_would_lead_compiled_code_astray_are_refused(change):
    """It checks no bounds: with more anchors than there are it would read and write beyond."""
    receiver = joint_receiver()
    assert save(load(save(receiver))) == save(receiver)
    assert refusal(changed(save(receiver), STATE, change)) == "checkpoint-damaged"


def test_a_state_for_two_dimensions_is_refused_where_three_are_estimated():
    """The almanac says how many there are."""
    page = encode_page(replace(joint_receiver()._receiver.almanac.schedule, tag_height_m=None))
    state = changed(
        save(joint_receiver()), ["almanac", "pages"], lambda pages: [page if p[0] == page[0] else p for p in pages]
    )
    assert refusal(state) == "checkpoint-damaged"


def pages_of(receiver):
    return receiver.state().almanac.pages


def joint_receiver():
    receiver = AnyReceiver("joint")
    for one in tape(LAB, 1.0):
        receiver.hear(one.reception)
    return receiver
