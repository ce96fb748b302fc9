"""Compile ``skyless_core.c`` and ``skyless_kernels.c``, which are made from Python, to libraries beside them.

The compiler is ``$CC``, or the first of cc, gcc and clang on the PATH, or else that of PyPI's ``ziglang``, which
``CC=ziglang`` asks for. ``SKYLESS_TARGET`` names another machine (x86_64-linux or aarch64-linux), for which ``ziglang``
compiles.

    python tools/compile_core.py
"""

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

NATIVE = Path("src/skyless/core/native")
NAMES = ("skyless_core", "skyless_kernels")
FLAGS = ["-std=c99", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared", "-fvisibility=hidden"]
AVX2_FLAGS = ["-mavx2", "-mbmi", "-mbmi2", "-mmovbe"]
"""One by one, because compilers before 2021 know no ``-march=x86-64-v3``, and zig writes it differently."""
ZIG = "ziglang==0.17.1"
TARGETS = {
    "x86_64-linux": ("x86_64-linux-gnu.2.17", "manylinux_2_17_x86_64"),
    "aarch64-linux": ("aarch64-linux-gnu.2.17", "manylinux_2_17_aarch64"),
}
"""What zig and wheels call a machine, with the oldest C library that serves."""
ADVICE = """\
Compiling needs a C compiler and the C library's headers (Debian, Ubuntu: apt install gcc libc6-dev).
CC names another compiler; with CC=ziglang the installation takes that of PyPI."""


def compiler() -> list[str]:
    """The command of the C compiler of this machine; empty where ``ziglang`` compiles."""
    asked = shlex.split(os.environ.get("CC", ""))
    if os.environ.get("SKYLESS_TARGET") or asked == ["ziglang"]:
        return []
    return asked or next(([name] for name in ("cc", "gcc", "clang") if shutil.which(name)), [])


def target() -> str:
    """The machine to compile for: that of ``SKYLESS_TARGET``, or this one.

    Raises:
        SystemExit: it is none of ``TARGETS``.
    """
    asked = os.environ.get("SKYLESS_TARGET")
    if asked and asked not in TARGETS:
        raise SystemExit(f"skyless: SKYLESS_TARGET is {asked}; it should be one of {', '.join(TARGETS)}")
    return asked or f"{platform.machine()}-{sys.platform}"


def build(native: Path) -> list[Path]:
    """Compile the libraries in a folder; where they stand. On x86-64 there is one more of each, for wider vectors.

    Raises:
        SystemExit: the compiler failed.
    """
    made = []
    for name in NAMES:
        made.append(compiled(native, name, f"lib{name}.so", []))
        if target().startswith(("x86_64-", "AMD64-")):
            made.append(compiled(native, name, f"lib{name}_avx2.so", AVX2_FLAGS))
    return made


def compiled(native: Path, name: str, made: str, flags: list[str]) -> Path:
    """Compile one library of a source. It is there as a whole, or as it was before."""
    source, library = native / f"{name}.c", native / made
    new = library.with_name(f"{library.stem}-{os.getpid()}.so")
    try:
        run([*(compiler() or _zig()), *FLAGS, *flags, digest_of(source), str(source), "-lm", "-o", str(new)])
        new.replace(library)
    finally:
        new.unlink(missing_ok=True)
    return library


def digest_of(source: Path) -> str:
    """The option that tells a library from which source it was made."""
    digest = hashlib.sha256(source.read_bytes() + source.with_suffix(".h").read_bytes()).hexdigest()[:16]
    return f'-DSKYLESS_SOURCE_DIGEST="{digest}"'


def _zig() -> list[str]:
    """The command of zig's compiler: for any processor of the machine, which without a target it would not be."""
    known = TARGETS.get(target())
    return [sys.executable, "-m", "ziglang", "cc", "-s", *(["-target", known[0]] if known else ["-mcpu=baseline"])]


def run(command: list[str], advice: str = ADVICE) -> None:
    """Run a compiler.

    Raises:
        SystemExit: there is none, or it failed.
    """
    with tempfile.TemporaryDirectory() as cache:
        folders = {"ZIG_GLOBAL_CACHE_DIR": cache, "ZIG_LOCAL_CACHE_DIR": cache}
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | folders)
        except OSError as error:
            raise SystemExit(f"skyless: {command[0]} cannot be run: {error}\n{advice}") from None
    if done.returncode:
        raise SystemExit(f"skyless: this failed: {shlex.join(command)}\n{done.stderr.rstrip()}\n{advice}")


if __name__ == "__main__":
    build(Path(__file__).parents[1] / NATIVE)
