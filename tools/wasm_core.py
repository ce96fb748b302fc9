"""Compile ``skyless_core.c`` to WebAssembly for the page, with clang and lld, without a C library.

python tools/wasm_core.py FILE.wasm
"""

import subprocess
import sys
from pathlib import Path

from compile_core import NATIVE

FLAGS = [
    "--target=wasm32", "-nostdlib", "-ffreestanding", "-std=c99", "-O3", "-ffp-contract=off", "-fno-math-errno",
    "-mbulk-memory", "-msimd128", "-Wl,--no-entry", "-Wl,--export-dynamic", "-Wl,--export=__heap_base",
]  # fmt: skip


def build(wasm: Path) -> None:
    """Compile.

    Raises:
        SystemExit: there is no clang, or it failed.
    """
    source = Path(__file__).parents[1] / NATIVE / "skyless_core.c"
    try:
        done = subprocess.run(["clang", *FLAGS, str(source), "-o", str(wasm)], check=False)
    except OSError as error:
        raise SystemExit(f"skyless: clang cannot be run: {error}; on Debian: apt install clang lld") from None
    if done.returncode:
        raise SystemExit("skyless: clang failed (see above)")


if __name__ == "__main__":
    build(Path(sys.argv[1]))
