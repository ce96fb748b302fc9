"""Where compiled kernels are kept: folders that cannot be written, files that were damaged, users without a home."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from skyless.site import kernels
from skyless.site.kernels import choose_folder

pytestmark = pytest.mark.site


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
    assert choose_folder(homes, "kernels-1") == path
    assert path.is_dir()
    assert not (tmp_path / "second").exists()


def test_a_folder_of_an_image_is_used_where_it_holds_kernels(tmp_path, unwritable):
    image, home = tmp_path / "image", tmp_path / "home"
    built = choose_folder((image, home), "kernels-1")
    unwritable.add(image)
    assert choose_folder((image, home), "kernels-1") == home / "kernels-1"
    (built / "kernel.nbi").touch()
    assert choose_folder((image, home), "kernels-1") == built


TWICE = """
import json
from skyless.site.kernels import kernel_folder
from skyless.site.kernels import kernel

@kernel
def twice(value: float) -> float:
    return 2.0 * value

value, folder, stats = twice(2.0), kernel_folder(), twice.stats
print(json.dumps([value, folder is not None, sum(stats.cache_hits.values()), sum(stats.cache_misses.values())]))
"""


@pytest.fixture
def run_twice(tmp_path):
    """Run a kernel in a program of its own: its value, whether its folder exists, cache hits and misses."""
    program = tmp_path / "program.py"
    program.write_text(TWICE)

    def run(folder):
        paths = {"NUMBA_CACHE_DIR": str(folder), "HOME": "/proc/nowhere", "XDG_CACHE_HOME": ""}
        done = subprocess.run(
            [sys.executable, program],
            env={**os.environ, **paths},
            capture_output=True,
            text=True,
            check=True,
        )
        return json.loads(done.stdout)

    return run


@pytest.mark.statistical
def test_a_damaged_file_is_compiled_again(run_twice, tmp_path):
    assert run_twice(tmp_path / "kept") == [4.0, True, 0, 1]
    assert run_twice(tmp_path / "kept") == [4.0, True, 1, 0]
    for pattern in ("*.nbi", "*.nbc"):
        (file,) = (tmp_path / "kept").rglob(pattern)
        file.write_bytes(b"")  # as a loss of power leaves it
        assert run_twice(tmp_path / "kept") == [4.0, True, 0, 1]
        assert run_twice(tmp_path / "kept") == [4.0, True, 1, 0]


def test_where_nothing_can_be_written_a_program_compiles_for_itself(monkeypatch):
    monkeypatch.setattr(kernels, "_homes", lambda: [Path("/proc/nowhere")])
    assert kernels.kernel_folder.__wrapped__() is None
    monkeypatch.setattr(kernels, "kernel_folder", lambda: None)
    twice = kernels.kernel(lambda value: 2.0 * value)
    assert twice(2.0) == 4.0


def imported(module, of):
    """Modules of the package that a module imports, by its syntax tree."""
    found = set()
    for node in ast.walk(ast.parse(of[module])):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
        elif isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
    return found & of.keys()


def test_the_folder_is_another_one_after_a_change_of_anything_that_a_kernel_may_use(monkeypatch):
    """Of the sources as they are: each module that some module with kernels imports, directly or not."""
    package = Path(kernels.__file__).parents[1]
    read = {file: file.read_bytes() for file in package.rglob("*.py")}
    of = {kernels._module(file, package): text for file, text in read.items()}
    wanted = {name for name, text in of.items() if b"skyless.site.kernels" in text}
    seen = set()
    while wanted:
        name = wanted.pop()
        seen.add(name)
        wanted |= imported(name, of) - seen
    assert {"skyless.core.clock_filter", "skyless.core.fix", "skyless.core.ticks"} <= seen
    hashed = []
    monkeypatch.setattr(kernels.hashlib, "sha1", lambda **_: SimpleNamespace(update=hashed.append, hexdigest=str))
    kernels.digest(package)
    assert {name for name in seen if of[name] not in hashed} == set()
    assert of["skyless.page.live"] not in hashed


@pytest.mark.parametrize(
    "line", ["from skyless.core.ticks import PER_S", "from skyless.core import (\n    air,\n    ticks,\n)"]
)
def test_a_constant_from_another_module_belongs_to_the_kernels(tmp_path, line):
    package, core = tmp_path / "skyless", tmp_path / "skyless" / "core"
    core.mkdir(parents=True)
    (core / "air.py").write_text(f"from skyless.site.kernels import kernel\n{line}\n")
    (package / "other.py").write_text("")
    (core / "ticks.py").write_text("PER_S = 1\n")
    first = kernels.digest(package)
    (package / "other.py").write_text("WIDTH = 2\n")
    assert kernels.digest(package) == first
    (core / "ticks.py").write_text("PER_S = 2\n")
    assert kernels.digest(package) != first


def test_a_home_that_may_not_be_searched_is_passed_over(tmp_path, monkeypatch):
    closed = tmp_path / "closed"

    def refuse(path, *_more, **_options):
        if closed in path.parents:
            raise PermissionError(path)
        return True

    for method in ("mkdir", "is_dir"):
        monkeypatch.setattr(Path, method, refuse)
    monkeypatch.setattr(os, "access", lambda *_: True)
    assert choose_folder((closed, tmp_path / "home"), "kernels-1") == tmp_path / "home" / "kernels-1"


def test_a_relative_folder_stays_the_same_for_programs_that_work_elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "kept")
    assert kernels.kernel_folder.__wrapped__().parent == tmp_path / "kept"
    assert os.environ["NUMBA_CACHE_DIR"] == str(tmp_path / "kept")


def test_a_folder_of_other_sources_that_is_used_now_and_then_is_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for name in ("kernels-used", "kernels-forgotten"):
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (0.0, 0.0))
    with monkeypatch.context() as patch:
        patch.setattr(kernels, "digest", lambda _: "used")
        patch.setattr(kernels, "_remove_unused", lambda _: None)
        kernels.kernel_folder.__wrapped__()  # another version starts
    own = kernels.kernel_folder.__wrapped__()
    assert {path.name for path in tmp_path.iterdir()} == {"kernels-used", own.name}
