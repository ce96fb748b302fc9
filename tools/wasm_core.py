"""Compile ``skyless_core.c`` to WebAssembly for the page, with clang and lld, without a C library.

python tools/wasm_core.py [FILE.wasm]          # without a name that of the page, which is committed
"""

import subprocess
import sys
from pathlib import Path

from compile_core import NATIVE, digest_of

FLAGS = [
    "--target=wasm32", "-nostdlib", "-ffreestanding", "-std=c99", "-Os", "-ffp-contract=off", "-fno-math-errno",
    "-mbulk-memory", "-msimd128", "-ffunction-sections", "-Wl,--no-entry", "-Wl,--gc-sections", "-Wl,--strip-all",
    "-Wl,--export=skyless_track", "-Wl,--export=skyless_source_digest", "-Wl,--export=__heap_base",
]  # fmt: skip

PAGE = Path(__file__).parents[1] / "src/skyless/page/browser/skyless_core.wasm"


def build(wasm: Path, *more: str) -> None:
    """Compile, with more options.

    Raises:
        SystemExit: there is no clang, or it failed.
    """
    source = Path(__file__).parents[1] / NATIVE / "skyless_core.c"
    try:
        done = subprocess.run(["clang", *FLAGS, *more, digest_of(source), str(source), "-o", str(wasm)], check=False)
    except OSError as error:
        raise SystemExit(f"skyless: clang cannot be run: {error}; on Debian: apt install clang lld") from None
    if done.returncode:
        raise SystemExit("skyless: clang failed (see above)")


if __name__ == "__main__":
    build(Path(sys.argv[1]) if len(sys.argv) > 1 else PAGE)
