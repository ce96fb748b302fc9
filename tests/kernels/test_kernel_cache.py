"""Where compiled kernels are kept: folders that cannot be written, files that were damaged, users without a home."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from skyless.kernels import cache
from skyless.kernels.cache import KernelFolder, choose_folder

KEY = "abc"


@pytest.fixture
def unwritable(monkeypatch):
    """Folders that this user may not write, also where that is root."""
    closed = set()
    may = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).parent not in closed and may(path, mode))
    return closed


def test_the_first_folder_that_can_be_written_is_used(tmp_path):
    (tmp_path / "file").touch()
    homes = (tmp_path / "file", tmp_path / "first", tmp_path / "second")
    path = tmp_path / "first" / "kernels-1"
    assert choose_folder(homes, "kernels-1", KEY) == KernelFolder(path, KEY, writable=True, temporary=False)
    assert path.is_dir()
    assert not (tmp_path / "second").exists()


def test_a_folder_of_an_image_is_used_where_it_holds_kernels_for_this_processor(tmp_path, unwritable):
    image, home = tmp_path / "image", tmp_path / "home"
    built = choose_folder((image, home), "kernels-1", KEY)
    built.mark_ready("air")
    unwritable.add(image)
    found = choose_folder((image, home), "kernels-1", KEY)
    assert found == KernelFolder(built.path, KEY, writable=False, temporary=False)
    assert found.is_ready("air")
    assert not found.is_ready("estimator")
    assert choose_folder((image, home), "kernels-1", "other processor").path == home / "kernels-1"
    assert choose_folder((image,), "kernels-1", "other processor") is None


def test_without_a_folder_kernels_are_kept_among_temporary_files_for_this_user_only(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    found = cache._temporary_folder("kernels-1", KEY)
    assert (found.writable, found.temporary) == (True, True)
    assert found.path.parent == tmp_path / f"skyless-{os.getuid()}"
    assert found.path.parent.stat().st_mode & 0o077 == 0
    assert cache._temporary_folder("kernels-1", KEY) == found
    found.path.parent.chmod(0o777)  # anybody could have written there: kernels are code
    other = cache._temporary_folder("kernels-1", KEY)
    assert other.path.parent != found.path.parent
    assert os.environ["NUMBA_CACHE_DIR"] == str(other.path.parent)


def test_where_nothing_can_be_written_there_is_still_an_answer(monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", "/proc/nowhere")
    found = cache._temporary_folder("kernels-1", KEY)
    assert (found.writable, found.temporary) == (False, True)
    found.mark_ready("air")
    assert not found.is_ready("air")


TWICE = """
import json, sys, tempfile
tempfile.tempdir = sys.argv[1]
from skyless.kernels.cache import kernel_folder
from skyless.kernels.compiled import kernel

@kernel
def twice(value: float) -> float:
    return 2.0 * value

value, folder, stats = twice(2.0), kernel_folder(), twice.stats
print(json.dumps([value, folder.writable, sum(stats.cache_hits.values()), sum(stats.cache_misses.values())]))
"""


@pytest.fixture
def run_twice(tmp_path):
    """Run a kernel in a program of its own: its value, whether its folder can be written, cache hits and misses."""
    program = tmp_path / "program.py"
    program.write_text(TWICE)

    def run(folder, temporary="/proc/nowhere", home="/proc/nowhere"):
        paths = {"NUMBA_CACHE_DIR": str(folder), "HOME": home, "XDG_CACHE_HOME": ""}
        done = subprocess.run(
            [sys.executable, program, temporary],
            env={**os.environ, **paths},
            capture_output=True,
            text=True,
            check=True,
        )
        return json.loads(done.stdout)

    return run


def test_a_damaged_file_is_compiled_again(run_twice, tmp_path):
    assert run_twice(tmp_path / "kept") == [4.0, True, 0, 1]
    assert run_twice(tmp_path / "kept") == [4.0, True, 1, 0]
    for pattern in ("*.nbi", "*.nbc"):
        (file,) = (tmp_path / "kept").rglob(pattern)
        file.write_bytes(b"")  # as a loss of power leaves it
        assert run_twice(tmp_path / "kept") == [4.0, True, 0, 1]
        assert run_twice(tmp_path / "kept") == [4.0, True, 1, 0]
