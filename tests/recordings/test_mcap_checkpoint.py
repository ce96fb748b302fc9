"""Receivers as bytes and back: the same bits afterwards, and nothing that a hostile recording could do."""

import pickle
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from machines.bench import LAB, PAIRS, ROOM, tape
from skyless.air.codec import decode, encode
from skyless.air.reception import Reception
from skyless.method_names import METHODS
from skyless.receiver import Receiver
from skyless.recordings.mcap.checkpoint import FORMAT, RefusedError, load, save
from skyless.recordings.mcap.checkpoint_reader import DamagedGraphError, read_graph
from skyless.recordings.mcap.checkpoint_writer import write_graph

RNG = np.random.default_rng(20)


def bits(fix):
    """All of a fix, to the bit."""
    return None if fix is None else save_value([getattr(fix, name) for name in fix.__struct_fields__])


def save_value(value):
    return msgspec.msgpack.encode(write_graph(value, {}))


@pytest.mark.parametrize("site", [LAB, ROOM, PAIRS], ids=["lab", "room", "pairs"])
@pytest.mark.parametrize("method", METHODS)
def test_a_receiver_goes_on_with_the_same_bits(method, site):
    heard = [one.reception for one in tape(site, 2.5)]
    cuts = set(RNG.choice(len(heard), 25, replace=False)) | {0, 1}
    straight, cut = Receiver(method), Receiver(method)
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
    straight, cut = Receiver(), Receiver()
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
    straight, cut = Receiver(), Receiver()
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
    envelope = msgspec.msgpack.decode(save(Receiver()))
    for change in ({"version": "0.0.1"}, {"format": 1}):
        assert refusal(msgspec.msgpack.encode(envelope | change)) == "checkpoint-of-another-version"


@pytest.mark.parametrize(
    "nodes",
    [
        [],
        [["object", "pathlib", "Path", [], []]],
        [["object", "skyless.cli.main", "main", [], []]],
        [["object", "skyless.air", "../x", [], []]],
        [["object", "skyless.receiver", "np", [], []]],
        [["class", "skyless.receiver", "Receiver"]],
        [["object", "skyless.air.codec", "Struct", [], []]],
        [["object", "skyless.receiver", "Receiver", ["__class__"], [1]], ["class", "skyless.ticks", "Unwrapper"]],
        [["tuple", [0]]],
        [["array", "O", [1], False, True, b"12345678"]],
        [["array", "<f8", [1 << 40], False, True, b"12345678"]],
        [["array", "<f8", [-1], False, True, b"12345678"]],
        [["dict", [1], [1]], ["list", []]],
        [["list", [1 << 70]]],
        [["=", {"a": 1}]],
        [[]],
        [17],
        [["tuple", [k + 1]] for k in range(5000)],
        [["int", "9" * 100_000]],
    ],
)
def test_graphs_of_other_things_are_refused(nodes):
    envelope = {"format": FORMAT, "version": msgspec.msgpack.decode(save(Receiver()))["version"]}
    try:
        state = msgspec.msgpack.encode({**envelope, "nodes": nodes})
    except OverflowError:
        with pytest.raises(DamagedGraphError):
            read_graph(nodes, {})
    else:
        assert refusal(state) == "checkpoint-damaged"


def test_arrays_that_kernels_would_run_over_are_refused():
    """Compiled code checks no bounds: a covariance of one number instead of 64 would be read and written beyond."""
    receiver = Receiver()
    for one in tape(LAB, 2.5):
        receiver.hear(one.reception)
    state = msgspec.msgpack.decode(save(receiver))
    arrays = [node for node in state["nodes"] if node[0] == "array"]
    assert len(arrays) > 10
    for node in arrays:
        kept = list(node)
        node[2], node[5] = [1], kept[5][:8]
        assert refusal(msgspec.msgpack.encode(state)) == "checkpoint-damaged"
        node[:] = kept
        node[1] = "<i8" if kept[1] == "<f8" else "<f8"
        assert refusal(msgspec.msgpack.encode(state)) == "checkpoint-damaged"
        node[:] = kept
    load(msgspec.msgpack.encode(state))


STATE = save(Receiver())


@given(st.data())
@settings(max_examples=300)
def test_damaged_bytes_are_refused_or_harmless(data):
    state = bytearray(STATE)
    for _ in range(data.draw(st.integers(1, 4))):
        state[data.draw(st.integers(0, len(state) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(state[: data.draw(st.integers(0, len(state)))])
    for damaged in (bytes(state), cut):
        try:
            assert type(load(damaged)) is Receiver
        except RefusedError as error:
            assert error.reason.startswith("checkpoint-")


def fill(array, place, value):
    array[place] = value


@pytest.mark.parametrize(
    "change",
    [
        lambda s: fill(s.index_of, 0, 5),
        lambda s: fill(s.index_of, 5, 1 << 40),
        lambda s: fill(s.index_of, 3, -1),
        lambda s: fill(s.anchors["table_index"], 2, -5),
        lambda s: fill(s.anchors["table_index"], 2, 6),
        lambda s: fill(s.anchors["table_index"], 2, s.anchors["table_index"][1]),
        lambda s: fill(s.settings["dim"], 0, 3),
        lambda s: fill(s.settings["dim"], 0, -1),
        lambda s: s._replace(index_of=s.index_of[:5].copy()),
        lambda s: s._replace(index_of=s.index_of.astype(np.int32)),
        lambda s: s._replace(P=s.P[:8, :8].copy()),
        lambda s: s._replace(P=s.P.astype(np.float32)),
        lambda s: s._replace(P=np.asfortranarray(s.P)),
        lambda s: s._replace(V=s.V[:-1].copy()),
        lambda s: s._replace(x=s.P),
        lambda s: s._replace(information=s.information[:1].copy()),
        lambda s: s._replace(evidence=s.evidence[:, 1:].copy()),
        lambda s: s._replace(anchors=s.anchors[:-1].copy()),
        lambda s: s._replace(packets=s.packets[:, :-1].copy()),
        lambda s: s._replace(links=s.links[:1].copy()),
        lambda s: s._replace(links=np.zeros(s.links.shape, s.packets.dtype)),
        lambda s: s._replace(status=s.status[:0].copy()),
        lambda s: s._replace(settings=s.settings[:0].copy()),
        lambda s: s._replace(h=s.h[:-1].copy()),
        lambda s: s._replace(h_index=s.h_index[:-1].copy()),
        lambda s: s._replace(ph=s.ph[:-1].copy()),
        lambda s: s._replace(fault_input=s.fault_input[:-1].copy()),
        lambda s: s._replace(x=None),
        tuple,
    ],
)
def test_states_that_would_lead_their_kernels_astray_are_refused(change):
    receiver = joint_receiver()
    assert save(load(save(receiver))) == save(receiver)
    estimator = receiver.method.estimator
    changed = change(estimator.state)
    if changed is not None:
        vars(estimator)["_state"] = changed
    assert refusal(save(receiver)) == "checkpoint-damaged"


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("dim", lambda _: 3),
        ("settings", lambda settings: replace(settings, height_m=None)),
        ("settings", lambda _: None),
        ("_table_m", lambda table_m: table_m[:-1]),
        ("_table_m", tuple),
        ("_table_m", lambda table_m: [*table_m[:-1], np.zeros(2)]),
        ("_identifiers", lambda identifiers: identifiers[:-1].copy()),
        ("_levels", lambda levels: levels[:-1].copy()),
        ("_rows", lambda rows: rows[:-1].copy()),
        ("_packed", lambda packed: packed[:-1].copy()),
        ("_packed", lambda packed: packed.astype(np.int64)),
        ("_listed", lambda listed: listed[:-1].copy()),
        ("_listed", lambda listed: listed[:, :3].copy()),
    ],
)
def test_estimators_that_would_lead_their_kernels_astray_are_refused(name, change):
    receiver = joint_receiver()
    own = vars(receiver.method.estimator)
    own[name] = change(own[name])
    assert refusal(save(receiver)) == "checkpoint-damaged"


@pytest.mark.parametrize("index", [-1, 6, 0.0, None])
def test_anchors_that_are_not_in_the_table_are_refused(index):
    receiver = joint_receiver()
    anchors = receiver.method.estimator.index_of
    anchors[next(iter(anchors))] = index
    assert refusal(save(receiver)) == "checkpoint-damaged"


def joint_receiver():
    receiver = Receiver("joint")
    for one in tape(LAB, 1.0):
        receiver.hear(one.reception)
    return receiver
