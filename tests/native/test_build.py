"""The library is compiled when Skyless is installed: with which compiler, for which machine, what a failure says."""

import ctypes
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from core_build import NATIVE, needs

import compile_core
from skyless.core.native import library

pytestmark = pytest.mark.site

ROOT = Path(__file__).parents[2]
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


def libraries(folder):
    return {path: path.read_bytes() for path in folder.iterdir() if "libskyless" in path.name}


@pytest.mark.site
@pytest.mark.parametrize("compiler", [pytest.param(name, marks=needs(name)) for name in ("cc", "gcc", "clang")])
def test_each_compiler_makes_libraries_and_a_source_with_an_error_leaves_them(native, monkeypatch, compiler):
    monkeypatch.setenv("CC", "" if compiler == "cc" else f"{compiler} -Werror")
    made = compile_core.build(native)
    before = libraries(native)
    assert before.keys() == set(made)
    loaded = ctypes.CDLL(str(made[0]))
    loaded.skyless_square.restype, loaded.skyless_square.argtypes = ctypes.c_double, [ctypes.c_double]
    assert loaded.skyless_square(1.5) == 2.25
    digest = ctypes.c_char_p.in_dll(loaded, "skyless_source_digest").value
    assert digest.decode() == library.source_digest(native / "skyless_core.c")
    (native / "skyless_core.c").write_text("this is no C\n")
    with pytest.raises(SystemExit, match=rf"(?s)failed: {compiler} .*no C.*apt install gcc.*CC=ziglang"):
        compile_core.build(native)
    assert libraries(native) == before


@pytest.mark.site
def test_a_compiler_or_a_machine_that_is_not_known_is_named(native, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler -O1")
    with pytest.raises(SystemExit, match=r"(?s)no-such-compiler cannot be run.*CC names another"):
        compile_core.build(native)
    assert libraries(native) == {}
    monkeypatch.setenv("SKYLESS_TARGET", "armv7-linux")
    with pytest.raises(SystemExit, match="SKYLESS_TARGET is armv7-linux; it should be one of x86_64-linux, aarch64"):
        compile_core.build(native)


def test_zig_compiles_for_any_processor_of_the_machine(native, monkeypatch):
    commands = []
    monkeypatch.setattr(compile_core, "run", lambda command: commands.append(command) or Path(command[-1]).touch())
    monkeypatch.setenv("PATH", str(native))
    monkeypatch.setenv("SKYLESS_TARGET", "aarch64-linux")
    made = compile_core.build(native)
    assert [path.name for path in made] == ["libskyless_core.so", "libskyless_kernels.so"]
    command, _ = commands
    assert command[:4] == [sys.executable, "-m", "ziglang", "cc"]
    assert command[command.index("-target") + 1] == "aarch64-linux-gnu.2.17"
    monkeypatch.delenv("SKYLESS_TARGET")
    compile_core.build(native)
    assert all("-target" in command or "-mcpu=baseline" in command for command in commands)


def test_the_wider_library_needs_no_instruction_that_is_not_looked_for():
    names = {"-mbmi": "bmi1"}
    assert {names.get(flag, flag.removeprefix("-m")) for flag in compile_core.AVX2_FLAGS} <= library._AVX2


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


@pytest.mark.parametrize(
    ("asked", "has_gcc", "dependencies"),
    [
        ({}, True, []),
        ({}, False, [compile_core.ZIG]),
        ({"CC": "ziglang"}, True, [compile_core.ZIG]),
        ({"CC": "mine -m64"}, True, []),
        ({"CC": "mine -m64", "SKYLESS_TARGET": "aarch64-linux"}, True, [compile_core.ZIG]),
    ],
)
def test_a_compiler_is_asked_for_only_where_there_is_none(hook, native, monkeypatch, asked, has_gcc, dependencies):
    (native / "gcc").touch(0o755 if has_gcc else 0o644)
    for name, value in {**asked, "PATH": str(native)}.items():
        monkeypatch.setenv(name, value)
    assert hook.dependencies() == dependencies


@pytest.mark.site
@needs("cc")
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
    made_from = {f"{name}.{suffix}" for name in compile_core.NAMES for suffix in "ch"}
    assert {path.name for path in ROOT.glob(pattern)} == made_from
    assert str(NATIVE.relative_to(ROOT / "src")) in environment
    assert "*.so" in (ROOT / ".gitignore").read_text().split()


@pytest.mark.site
@needs("bash")
def test_the_script_of_wheels_names_the_machines_that_are_known():
    subprocess.run(["bash", "-n", ROOT / "scripts" / "wheels"], check=True)
    lines = (ROOT / "scripts" / "wheels").read_text().splitlines()
    line = next(line for line in lines if line.startswith("for target"))
    assert line.removeprefix("for target in ").removesuffix("; do").split() == list(compile_core.TARGETS)
