"""Compile ``skyless_core.c`` to WebAssembly for the page, with clang and lld, without a C library.

python tools/wasm_core.py [FILE.wasm]          # without a name that of the page, which is committed
"""

import sys
from pathlib import Path

from compile_core import NATIVE, digest_of, run

FLAGS = [
    "--target=wasm32", "-nostdlib", "-ffreestanding", "-std=c99", "-Os", "-ffp-contract=off", "-fno-math-errno",
    "-mbulk-memory", "-msimd128", "-ffunction-sections", "-Wl,--no-entry", "-Wl,--gc-sections", "-Wl,--strip-all",
    "-Wl,--export=skyless_track", "-Wl,--export=skyless_source_digest", "-Wl,--export=__heap_base",
]  # fmt: skip

PAGE = Path(__file__).parents[1] / "src/skyless/page/browser/skyless_core.wasm"


def build(wasm: Path, *more: str) -> None:
    """Compile, with more options. Raises SystemExit."""
    source = Path(__file__).parents[1] / NATIVE / "skyless_core.c"
    run(["clang", *FLAGS, *more, digest_of(source), str(source), "-o", str(wasm)], "Debian: apt install clang lld")


if __name__ == "__main__":
    build(Path(sys.argv[1]) if len(sys.argv) > 1 else PAGE)
