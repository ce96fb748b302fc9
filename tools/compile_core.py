"""Compile ``skyless_core.c``, which is made from the estimator's Python, to a library beside it.

It takes ``$CC``, or the first of cc, gcc and clang that there is, or else PyPI's ``ziglang``. ``SKYLESS_TARGET`` names
another machine (x86_64-linux or aarch64-linux), for which ``ziglang`` compiles.

    python tools/compile_core.py
"""

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

NATIVE = Path("src/skyless/core/native")
FLAGS = ["-std=c99", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared", "-fvisibility=hidden"]
ZIG = "ziglang>=0.13"
TARGETS = {
    "x86_64-linux": ("x86_64-linux-gnu.2.17", "manylinux_2_17_x86_64"),
    "aarch64-linux": ("aarch64-linux-gnu.2.17", "manylinux_2_17_aarch64"),
}


def compiler() -> list[str]:
    """The command of the C compiler of this machine; empty where there is none, or for another machine."""
    if os.environ.get("SKYLESS_TARGET"):
        return []
    if asked := shlex.split(os.environ.get("CC", "")):
        return asked
    return next(([name] for name in ("cc", "gcc", "clang") if shutil.which(name)), [])


def build(native: Path) -> list[Path]:
    """Compile the libraries in a folder; where they stand. On x86-64 there is one more, for wider vectors.

    Raises:
        SystemExit: the compiler failed.
    """
    machine = os.environ.get("SKYLESS_TARGET", platform.machine())
    made = [compiled(native, "libskyless_core.so", [])]
    if machine.startswith(("x86_64", "AMD64")):
        made.append(compiled(native, "libskyless_core_avx2.so", ["-march=x86-64-v3"]))
    return made


def compiled(native: Path, name: str, flags: list[str]) -> Path:
    """Compile one library."""
    source, library = native / "skyless_core.c", native / name
    digest = hashlib.sha256(source.read_bytes() + source.with_suffix(".h").read_bytes()).hexdigest()[:16]
    target = os.environ.get("SKYLESS_TARGET")
    zig = [sys.executable, "-m", "ziglang", "cc", *(["-target", TARGETS[target][0]] if target else [])]
    new, given = library.with_suffix(f".{os.getpid()}"), f'-DSKYLESS_SOURCE_DIGEST="{digest}"'
    command = [*(compiler() or zig), *FLAGS, *flags, given, str(source), "-o", str(new)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise SystemExit(f"skyless: {command[0]} cannot be run: {error}; CC names another C compiler") from None
    if done.returncode:
        new.unlink(missing_ok=True)
        raise SystemExit(f"skyless: {shlex.join(command)} failed:\n{done.stderr}CC names another C compiler")
    new.replace(library)
    return library


if __name__ == "__main__":
    build(Path(__file__).parents[1] / NATIVE)
