"""What processes and the ether say to each other, cut and spoilt in every way."""

import itertools

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.radio import emulated

TICKS = st.integers(0, 2**40 - 1)
NODES = st.integers(0, 300)
FINITE = st.floats(allow_nan=False, allow_infinity=False)
TO_ETHER = st.one_of(
    st.builds(emulated.Join, st.sampled_from(["anchor", "tag"]), st.lists(st.text(max_size=20)).map(tuple)),
    st.builds(emulated.Send, NODES, TICKS, st.binary(max_size=127)),
)
PHASES = st.one_of(st.none(), st.floats(0.0, 1.0, exclude_max=True))
ROWS = st.builds(emulated.HeardRow, NODES, TICKS, FINITE, FINITE, FINITE, PHASES)
FROM_ETHER = st.one_of(
    st.builds(emulated.Joined, st.text(max_size=40), FINITE, st.lists(TICKS).map(tuple)),
    st.builds(emulated.Refused, st.text()),
    st.builds(emulated.Clocks, FINITE, st.lists(TICKS).map(tuple)),
    st.builds(emulated.Arrival, st.binary(max_size=127), FINITE, st.lists(ROWS, max_size=5).map(tuple)),
    st.builds(emulated.Done, NODES, TICKS, st.booleans()),
)


def pieces_of(stream, cuts):
    places = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    return [stream[begin:end] for begin, end in itertools.pairwise(places)]


@pytest.mark.site
@pytest.mark.parametrize(("said", "decoder"), [(TO_ETHER, emulated.to_ether), (FROM_ETHER, emulated.from_ether)])
@given(st.data(), st.lists(st.integers(0, 10_000), max_size=30))
def test_what_is_said_arrives_however_the_stream_is_cut(said, decoder, data, cuts):
    messages, unpacker = data.draw(st.lists(said, max_size=8)), emulated.Unpacker()
    stream = b"".join(emulated.pack(message) for message in messages)
    bodies = [body for piece in pieces_of(stream, cuts) for body in unpacker.feed(piece)]
    assert [decoder.decode(body) for body in bodies] == messages


@given(st.binary(max_size=400), st.lists(st.integers(0, 400), max_size=10))
def test_garbage_raises_nothing_but_what_is_announced(garbage, cuts):
    unpacker = emulated.Unpacker()
    try:
        for piece in pieces_of(garbage, cuts):
            for body in unpacker.feed(piece):
                emulated.to_ether.decode(body)
    except (emulated.WireError, msgspec.MsgspecError):
        pass


@given(TO_ETHER, st.data())
def test_a_message_that_lacks_its_end_does_not_come_out(message, data):
    stream = emulated.pack(message)
    assert list(emulated.Unpacker().feed(stream[: data.draw(st.integers(0, len(stream) - 1))])) == []


def test_a_length_beyond_all_messages_is_refused_before_it_is_waited_for():
    good = emulated.pack(emulated.Refused("no"))
    feed = emulated.Unpacker().feed(good + (emulated.MAX_MESSAGE_BYTES + 1).to_bytes(4, "little"))
    assert emulated.from_ether.decode(next(feed)) == emulated.Refused("no")
    with pytest.raises(emulated.WireError, match=str(emulated.MAX_MESSAGE_BYTES)):
        next(feed)
    assert list(emulated.Unpacker().feed(emulated.MAX_MESSAGE_BYTES.to_bytes(4, "little"))) == []


def test_the_largest_arrival_of_a_large_site_fits():
    rows = tuple(emulated.HeardRow(node, 2**40 - 1, -80.0, -85.0, 1.5, 0.1) for node in range(1000))
    assert len(emulated.pack(emulated.Arrival(bytes(127), 1.0, rows))) < emulated.MAX_MESSAGE_BYTES


def test_a_row_of_an_older_ether_has_no_phase():
    body = msgspec.msgpack.encode(
        {"type": "arrival", "frame": b"f", "host_s": 1.0, "rows": [[0, 5, -80.0, -85.0, 1.5]]}
    )
    assert emulated.from_ether.decode(body) == emulated.Arrival(
        b"f", 1.0, (emulated.HeardRow(0, 5, -80.0, -85.0, 1.5),)
    )


def test_a_machine_without_a_boot_identifier_shares_its_clock_with_itself_only_by_name(monkeypatch):
    here = emulated.this_machine()
    assert here == emulated.this_machine()

    def missing(*_, **__):
        raise FileNotFoundError

    monkeypatch.setattr(emulated.Path, "read_text", missing)
    assert emulated.this_machine() == ""
