"""The library is compiled when Skyless is installed: with which compiler, for which machine, what a failure says."""

import ctypes
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from core_build import NATIVE, has

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

import compile_core
from skyless.core.native import library

pytestmark = pytest.mark.site

ROOT = Path(__file__).parents[2]

with_cc = pytest.mark.skipif(not has("cc"), reason="there is no cc")

SMALL = """
#include "skyless_core.h"
SKYLESS_EXPORT extern const char *const skyless_source_digest;
const char *const skyless_source_digest = SKYLESS_SOURCE_DIGEST;
SKYLESS_EXPORT double skyless_square(double x) { return x * x; }
"""


@pytest.fixture
def native(tmp_path, monkeypatch):
    """A folder with a small source, and an environment that asks for nothing."""
    for name in ("CC", "SKYLESS_TARGET"):
        monkeypatch.delenv(name, raising=False)
    for name in compile_core.NAMES:
        (tmp_path / f"{name}.c").write_text(SMALL.replace("skyless_core", name))
        (tmp_path / f"{name}.h").write_text('#define SKYLESS_EXPORT __attribute__((visibility("default")))\n')
    return tmp_path


@pytest.fixture
def no_compiler(native, monkeypatch):
    monkeypatch.setenv("PATH", str(native))


def libraries(folder):
    return sorted(path.name for path in folder.iterdir() if "libskyless" in path.name)


@with_cc
def test_the_library_has_the_exported_functions_and_the_digest_of_its_source(native):
    made = compile_core.build(native)
    assert libraries(native) == sorted(path.name for path in made)
    loaded = ctypes.CDLL(str(made[0]))
    loaded.skyless_square.restype, loaded.skyless_square.argtypes = ctypes.c_double, [ctypes.c_double]
    assert loaded.skyless_square(1.5) == 2.25
    digest = ctypes.c_char_p.in_dll(loaded, "skyless_source_digest").value
    assert digest.decode() == library.source_digest(native / "skyless_core.c")


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_each_compiler_takes_all_flags(native, monkeypatch, compiler):
    if not has(compiler):
        pytest.skip(f"there is no {compiler}")
    monkeypatch.setenv("CC", f"{compiler} -Werror")
    assert all(path.exists() for path in compile_core.build(native))


@with_cc
def test_a_source_that_does_not_compile_leaves_the_library_as_it_was(native):
    before = [(path, path.read_bytes()) for path in compile_core.build(native)]
    (native / "skyless_core.c").write_text("this is no C\n")
    with pytest.raises(SystemExit, match=r"(?s)failed: cc .*no C.*apt install gcc.*CC=ziglang"):
        compile_core.build(native)
    assert libraries(native) == sorted(path.name for path, _ in before)
    assert all(path.read_bytes() == content for path, content in before)


def test_a_compiler_that_is_not_there_is_named(native, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler -O1")
    with pytest.raises(SystemExit, match=r"(?s)no-such-compiler cannot be run.*CC names another"):
        compile_core.build(native)
    assert libraries(native) == []


def test_zig_compiles_for_any_processor_of_the_machine(no_compiler, monkeypatch):
    commands = []
    monkeypatch.setattr(compile_core, "run", lambda command: commands.append(command) or Path(command[-1]).touch())
    monkeypatch.setenv("SKYLESS_TARGET", "aarch64-linux")
    made = compile_core.build(Path(os.environ["PATH"]))
    assert [path.name for path in made] == ["libskyless_core.so", "libskyless_kernels.so"]
    command, _ = commands
    assert command[:4] == [sys.executable, "-m", "ziglang", "cc"]
    assert command[command.index("-target") + 1] == "aarch64-linux-gnu.2.17"
    monkeypatch.delenv("SKYLESS_TARGET")
    compile_core.build(Path(os.environ["PATH"]))
    assert all("-target" in command or "-mcpu=baseline" in command for command in commands)


def test_the_wider_library_needs_no_instruction_that_is_not_looked_for():
    names = {"-mbmi": "bmi1"}
    assert {names.get(flag, flag.removeprefix("-m")) for flag in compile_core.AVX2_FLAGS} <= library._AVX2


def test_a_machine_that_is_not_known_is_named(native, monkeypatch):
    monkeypatch.setenv("SKYLESS_TARGET", "armv7-linux")
    with pytest.raises(SystemExit, match="SKYLESS_TARGET is armv7-linux; it should be one of x86_64-linux, aarch64"):
        compile_core.build(native)


@pytest.fixture
def hook(native):
    """The build hook, for a project with the small source."""
    pytest.importorskip("hatchling", reason="hatchling is not installed")
    sys.path.insert(0, str(ROOT))
    try:
        from hatch_build import CoreBuildHook
    finally:
        sys.path.remove(str(ROOT))
    folder = native / compile_core.NATIVE
    folder.mkdir(parents=True)
    for file in native.glob("skyless_*.[ch]"):
        shutil.copy(file, folder)
    return CoreBuildHook(str(native), {}, None, None, "", "wheel")


def test_a_compiler_is_asked_for_only_where_there_is_none(hook, native, monkeypatch):
    (native / "gcc").write_text("")
    (native / "gcc").chmod(0o755)
    monkeypatch.setenv("PATH", str(native))
    assert hook.dependencies() == []
    monkeypatch.setenv("CC", "ziglang")
    assert hook.dependencies() == [compile_core.ZIG]
    monkeypatch.setenv("CC", "mine -m64")
    assert hook.dependencies() == []
    monkeypatch.setenv("SKYLESS_TARGET", "aarch64-linux")
    assert hook.dependencies() == [compile_core.ZIG]
    for name in ("CC", "SKYLESS_TARGET"):
        monkeypatch.delenv(name)
    (native / "gcc").unlink()
    assert hook.dependencies() == [compile_core.ZIG]


@with_cc
def test_the_wheel_holds_the_libraries_and_names_its_platform(hook, native):
    data = {"artifacts": []}
    hook.initialize("standard", data)
    assert data["artifacts"][0] == "/src/skyless/core/native/libskyless_core.so"
    assert all((native / name.lstrip("/")).exists() for name in data["artifacts"])
    assert data["tag"].startswith("py3-none-")
    assert not data["pure_python"]


def test_git_ignores_libraries_and_uv_and_scripts_watch_all_that_they_are_made_from():
    configuration = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert configuration["tool"]["hatch"]["build"]["targets"]["wheel"]["hooks"] == {"custom": {}}
    watched = [key["file"] for key in configuration["tool"]["uv"]["cache-keys"]]
    environment = (ROOT / "scripts" / "environment").read_text()
    for file in ("pyproject.toml", "hatch_build.py", "tools/compile_core.py"):
        assert file in watched
        assert f'"$root/{file}"' in environment
    (pattern,) = [name for name in watched if "*" in name]
    assert {path.name for path in ROOT.glob(pattern)} == {
        f"{name}.{suffix}" for name in compile_core.NAMES for suffix in "ch"
    }
    assert str(NATIVE.relative_to(ROOT / "src")) in environment
    assert "*.so" in (ROOT / ".gitignore").read_text().split()


@pytest.mark.skipif(not has("bash"), reason="there is no bash")
def test_the_script_of_wheels_names_the_machines_that_are_known():
    subprocess.run(["bash", "-n", ROOT / "scripts" / "wheels"], check=True)
    line = next(
        line for line in (ROOT / "scripts" / "wheels").read_text().splitlines() if line.startswith("for target")
    )
    assert line.removeprefix("for target in ").removesuffix("; do").split() == list(compile_core.TARGETS)
