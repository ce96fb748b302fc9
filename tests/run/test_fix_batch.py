"""Batches of fixes: what is encoded is what another decoder and ours find, and damaged bytes are refused."""

import math
import struct

import numpy as np
import pytest
from gathered_fixes import FIX
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.alert import Alert
from skyless.run import fix_batch

pytestmark = pytest.mark.site

HEADER = "<4sHHIIQII"
STATED = "<IHBBQiiifffHHhh"  # as docs/batches.md states them
u32 = st.integers(0, 2**32 - 1)
u64 = st.integers(0, 2**64 - 1)
numbers = st.floats(allow_nan=False, allow_infinity=False)
vectors = st.tuples(numbers, numbers, numbers)
raw_records = st.binary(max_size=20 * 48).map(
    lambda data: np.frombuffer(data[: len(data) // 48 * 48], fix_batch.RECORD)
)
batches = st.builds(fix_batch.Batch, u32, u32, u64, u32, raw_records)
fixes = st.builds(
    lambda **fields: replace(FIX, **fields),
    tag=st.text(max_size=5),
    unix_s=numbers,
    position_m=vectors,
    covariance_m2=st.tuples(*[numbers] * 9),
    velocity_mps=st.none() | vectors,
    anchors=st.lists(st.integers(0, 9), max_size=300).map(tuple),
    height_known=st.booleans(),
    hpl_m=st.none() | numbers,
    alert=st.none() | st.sampled_from(Alert) | st.just("of-a-later-version"),
    verified_until_s=st.none() | numbers,
)


@given(batches)
def test_a_batch_has_the_stated_layout(batch):
    data = fix_batch.encode_batch(batch)
    magic, header, size, run, sequence, sent, issue, count = struct.unpack_from(HEADER, data)
    assert (magic, header, size, count) == (b"SKB2", 32, 48, len(batch.records))
    assert (run, sequence, sent, issue) == (batch.run, batch.sequence, batch.sent_unix_us, batch.names_issue)
    assert struct.calcsize(STATED) == 48
    assert len(data) == 32 + 48 * count
    for row, record in zip(struct.iter_unpack(STATED, data[32:]), batch.records, strict=True):
        stated = (*record.tolist()[:5], *record["position_mm"], *record["covariance_m2"], *record.tolist()[7:9])
        np.testing.assert_array_equal(row[:13], stated)
        np.testing.assert_array_equal(row[13:], record["velocity_cmps"])


@given(batches, st.integers(0, 9), st.integers(0, 9))
def test_readers_skip_what_longer_headers_and_records_have(batch, more_header, more_record):
    plain = fix_batch.encode_batch(batch)
    head = bytearray(plain[: fix_batch.HEADER_BYTES])
    struct.pack_into("<HH", head, 4, fix_batch.HEADER_BYTES + more_header, fix_batch.RECORD.itemsize + more_record)
    rows = [plain[at : at + 48] + b"\xaa" * more_record for at in range(fix_batch.HEADER_BYTES, len(plain), 48)]
    found = fix_batch.decode_batch(bytes(head) + b"\xbb" * more_header + b"".join(rows))
    assert found.records.tobytes() == batch.records.tobytes()
    assert (found.run, found.sequence, found.sent_unix_us) == (batch.run, batch.sequence, batch.sent_unix_us)


@given(batches, st.data())
def test_damaged_bytes_are_refused_or_a_batch_and_raise_nothing_else(batch, data):
    plain = bytearray(fix_batch.encode_batch(batch))
    for at in data.draw(st.lists(st.integers(0, len(plain) - 1), max_size=4)):
        plain[at] ^= data.draw(st.integers(1, 255))
    damaged = bytes(plain[: data.draw(st.integers(0, len(plain)))])
    try:
        found = fix_batch.decode_batch(damaged)
    except fix_batch.BadBatchError:
        return
    assert found.records.dtype == fix_batch.RECORD


@given(st.binary(max_size=200))
def test_other_bytes_are_refused(data):
    with pytest.raises(fix_batch.BadBatchError):
        fix_batch.decode_batch(data)


def near(found, value, scale, most):
    """Whether a field holds a value, or its limit."""
    wanted = scale * value
    wanted = min(max(round(wanted), -most), most) if math.isfinite(wanted) else 0
    return int(found) == wanted


@settings(max_examples=30)
@given(st.lists(st.tuples(u32, fixes), max_size=5), st.booleans())
def test_records_hold_what_fixes_state(numbered, simulated):
    records = fix_batch.records_of(numbered, simulated=simulated)
    for record, (number, fix) in zip(records, numbered, strict=True):
        flags = int(record["flags"])
        assert (record["tag"], record["anchors"]) == (number, min(len(fix.anchors), 255))
        assert bool(flags & fix_batch.HEIGHT_GIVEN) == fix.height_known
        assert bool(flags & fix_batch.VELOCITY_KNOWN) == (fix.velocity_mps is not None)
        assert bool(flags & fix_batch.VERIFIED) == (fix.verified_until_s is not None)
        stated = fix.alert if fix.alert in (None, *fix_batch.ALERTS) else Alert.UNAVAILABLE
        assert (flags & fix_batch.ALERT_BITS) == (0 if stated is None else 1 + fix_batch.ALERTS.index(stated))
        assert all(near(*pair, 1000.0, 2**31 - 1) for pair in zip(record["position_mm"], fix.position_m, strict=True))
        assert record["unix_us"] == 0 or near(record["unix_us"], fix.unix_s, 1e6, 2**63 - 1)
        assert (record["hpl_cm"] == fix_batch.NONE_U16) >= (fix.hpl_m is None)
        assert not fix.height_known or record["std_z_mm"] == fix_batch.NONE_U16


@given(raw_records, st.booleans())
def test_the_fix_of_a_record_gives_the_same_record_again(records, simulated):
    """But for the number of anchors and the method, which have no place in a fix, and alerts of later versions."""
    finite = np.isfinite(records["covariance_m2"]).all(axis=1)
    records = records[finite & (records["unix_us"] < 2**50)].copy()
    records["covariance_m2"] = np.abs(records["covariance_m2"])
    flags = records["flags"]
    flags[:] = (flags & (fix_batch.VERIFIED | fix_batch.VELOCITY_KNOWN | fix_batch.HEIGHT_GIVEN)) | (
        flags & fix_batch.ALERT_BITS
    ) % (1 + len(fix_batch.ALERTS))
    flags[:] |= fix_batch.SIMULATED * simulated
    flags[records["std_z_mm"] == fix_batch.NONE_U16] |= fix_batch.HEIGHT_GIVEN
    records["std_z_mm"][flags & fix_batch.HEIGHT_GIVEN > 0] = fix_batch.NONE_U16
    records["velocity_cmps"][flags & fix_batch.VELOCITY_KNOWN == 0] = 0
    for field in ("position_mm", "velocity_cmps"):
        records[field] = np.maximum(records[field], -np.iinfo(records[field].dtype).max)
    records["anchors"], records["method"] = 0, 0
    numbered = [(row[0], fix_batch.fix_of("a", row)) for row in fix_batch.FIELDS.iter_unpack(records.tobytes())]
    np.testing.assert_array_equal(fix_batch.records_of(numbered, simulated=simulated), records)
