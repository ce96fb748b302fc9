"""Files are there whole or not at all, in their order, with the usual rights; pipes are written to."""

import os
import threading
from pathlib import Path

import pytest

from skyless.files import replace_files, whole_file, write_whole


def test_a_failed_write_leaves_the_old_files(tmp_path):
    paths = tmp_path / "first", tmp_path / "second"
    replace_files(dict.fromkeys(paths, b"old"))
    with pytest.raises(TypeError):
        replace_files({paths[0]: b"new", paths[1]: "text, not bytes"})
    with pytest.raises(KeyboardInterrupt), whole_file(paths[0]) as scratch:
        scratch.write_bytes(b"a part")
        raise KeyboardInterrupt
    assert [path.read_bytes() for path in paths] == [b"old", b"old"]
    assert sorted(tmp_path.iterdir()) == sorted(paths)


def test_files_are_replaced_in_their_order_after_all_have_been_written(tmp_path, monkeypatch):
    order, replaced, replace = [tmp_path / name for name in ("c", "a", "b")], [], Path.replace

    def note(scratch, path):
        assert len(list(tmp_path.iterdir())) == 3
        replaced.append(path)
        replace(scratch, path)

    monkeypatch.setattr(Path, "replace", note)
    replace_files({path: path.name.encode() for path in order})
    assert replaced == order
    assert [path.read_bytes() for path in order] == [b"c", b"a", b"b"]


def test_a_file_has_the_rights_that_the_user_gives_to_new_ones(tmp_path):
    before = os.umask(0o027)
    try:
        write_whole(tmp_path / "file", b"")
    finally:
        os.umask(before)
    assert (tmp_path / "file").stat().st_mode & 0o777 == 0o640


def test_a_pipe_stays_one(tmp_path):
    pipe = tmp_path / "picture.png"
    os.mkfifo(pipe)
    found = []
    reader = threading.Thread(target=lambda: found.append(pipe.read_bytes()))
    reader.start()
    write_whole(pipe, b"all of it")
    reader.join()
    assert found == [b"all of it"]
    assert pipe.is_fifo()
