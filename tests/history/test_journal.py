"""The journal: what it gives back after a program was killed, the disk was full, or a byte has changed."""

import errno
import os
import struct
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.run.history.journal import Journal, frames_of

FRAMES = st.lists(st.binary(max_size=40), min_size=1, max_size=8)


def written(folder, payloads, first=1):
    journal = Journal(folder, "fixes")
    journal.begin(first)
    for number, payload in enumerate(payloads, first):
        journal.append(number, payload)
    journal.close()
    return journal


@given(FRAMES)
def test_a_file_that_ends_at_any_byte_gives_its_whole_frames(tmp_path_factory, payloads):
    folder = tmp_path_factory.mktemp("journal")
    written(folder, payloads)
    (file,) = folder.iterdir()
    data = file.read_bytes()
    ends = [sum(16 + len(payload) for payload in payloads[:count]) for count in range(len(payloads) + 1)]
    assert ends[-1] == len(data)
    for length in range(len(data) + 1):
        whole = sum(end <= length for end in ends) - 1
        assert list(frames_of(data[:length])) == list(enumerate(payloads[:whole], 1))


@given(FRAMES, st.data())
def test_a_changed_byte_ends_the_file_at_its_frame(payloads, data):
    journal, ends = bytearray(), []
    for number, payload in enumerate(payloads, 1):  # the format as its document states it
        rest = struct.pack("<IQ", len(payload), number) + payload
        journal += struct.pack("<I", zlib.crc32(rest)) + rest
        ends.append(len(journal))
    assert list(frames_of(bytes(journal))) == list(enumerate(payloads, 1))
    at = data.draw(st.integers(0, len(journal) - 1))
    journal[at] ^= data.draw(st.integers(1, 255))
    before = sum(end <= at for end in ends)
    assert list(frames_of(bytes(journal))) == list(enumerate(payloads[:before], 1))


@settings(max_examples=30)
@given(st.lists(st.lists(st.binary(max_size=9), max_size=4), min_size=1, max_size=5), st.integers(0, 25))
def test_files_follow_one_another_and_go_when_their_rows_are_elsewhere(tmp_path_factory, files, last):
    journal, number = Journal(tmp_path_factory.mktemp("journal"), "fixes"), 1
    frames = []
    for payloads in files:
        journal.begin(number)
        for payload in payloads:
            journal.append(number, payload)
            frames.append((number, payload))
            number += 1
    assert list(journal.read()) == frames
    journal.drop_through(last)
    left = list(journal.read())
    assert left == frames[len(frames) - len(left) :]
    assert [frame for frame in frames if frame[0] > last] == [frame for frame in left if frame[0] > last]
    assert journal.end() <= number
    journal.close()


def test_a_full_disk_leaves_nothing_behind_and_the_journal_goes_on(tmp_path, monkeypatch):
    journal = Journal(tmp_path, "fixes")
    journal.begin(1)
    journal.append(1, b"first")
    pwrite, room = os.pwrite, [20]

    def full(handle, data, at):
        part = bytes(data[: room[0]])
        room[0] -= len(part)
        if not part:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return pwrite(handle, part, at)

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(OSError, match="No space left"):
        journal.append(2, b"too long for what is left")
    assert list(journal.read()) == [(1, b"first")]
    room[0] = 1000
    journal.append(2, b"second")
    assert list(journal.read()) == [(1, b"first"), (2, b"second")]
    journal.close()


def test_what_could_not_even_be_cut_off_is_written_over(tmp_path, monkeypatch):
    journal = Journal(tmp_path, "fixes")
    journal.begin(1)

    def fail(*_):
        raise OSError(errno.EIO, "no")

    with monkeypatch.context() as patch:
        patch.setattr(os, "ftruncate", fail)
        pwrite = os.pwrite
        patch.setattr(os, "pwrite", lambda handle, data, at: pwrite(handle, data[:5], at) if at < 5 else fail())
        with pytest.raises(OSError, match="no"):
            journal.append(1, b"torn, and longer than the next")
    journal.append(1, b"next")
    assert list(journal.read()) == [(1, b"next")]
    journal.close()
