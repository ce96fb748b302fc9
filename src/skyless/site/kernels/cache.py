"""Where kernels are kept that Numba has compiled.

The folder belongs to exactly these sources: the compiler notices a change of the kernel's own file but not of what it
calls, nor of constants from elsewhere, so a digest of all files with kernels, and of all that these import, stands in
its name. Folders of other sources are removed when they have not been used for long.

The first of these is used that can be written, or that cannot but holds kernels (an image): ``NUMBA_CACHE_DIR``, next
to the sources, the user's cache. Where there is none, every program compiles for itself.
"""

import hashlib
import os
import re
import shutil
import time
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Final

_PACKAGE: Final = Path(__file__).parents[2]
_IMPORT: Final = re.compile(rb"from (skyless[\w.]*) import (\([^)]*\)|.*)")
_KEPT_S: Final = 7 * 86_400.0
"""Kernels of other sources are kept for a week after their last use: several versions may share a folder."""


@cache
def kernel_folder() -> Path | None:
    """Where this program keeps compiled kernels; None where no folder can be written."""
    if asked := os.environ.get("NUMBA_CACHE_DIR"):
        # absolute for the programs that this one starts, too: they may change their working folder
        os.environ["NUMBA_CACHE_DIR"] = str(Path(asked).absolute())
    name = f"kernels-{digest(_PACKAGE)}"
    found = choose_folder(_homes(), name)
    if found is not None:
        with suppress(OSError):
            os.utime(found)  # its time is that of its last use
            _remove_unused(found)
    return found


def choose_folder(homes: Iterable[Path], name: str) -> Path | None:
    """The folder in the first home where it can be written, or cannot but holds kernels; None if there is none."""
    for home in homes:
        path = home / name
        with suppress(OSError):
            path.mkdir(parents=True, exist_ok=True)
        with suppress(OSError):  # a home that may not be searched
            if path.is_dir() and (os.access(path, os.W_OK | os.X_OK) or any(path.iterdir())):
                return path
    return None


def _homes() -> Iterable[Path]:
    if asked := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(asked)
    yield _PACKAGE / "__pycache__"
    cached = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if cached.is_absolute():  # a relative one is not valid
        yield cached / "skyless"
    with suppress(RuntimeError):  # a user without a home
        yield Path.home() / ".cache" / "skyless"


def digest(package: Path) -> str:
    """Digest of the files of the package ``skyless`` that hold kernels, and of all that these import."""
    texts = {_module(file, package): file.read_bytes() for file in sorted(package.rglob("*.py"))}
    wanted = [name for name, text in texts.items() if b"skyless.site.kernels.compiled" in text or ".kernels." in name]
    used: set[str] = set()
    while wanted:
        name = wanted.pop()
        if name in texts and name not in used:
            used.add(name)
            for module, names in _IMPORT.findall(texts[name]):
                origin = module.decode()
                wanted += [origin, *(f"{origin}.{one}" for one in re.findall(r"\w+", names.decode()))]
    found = hashlib.sha1(usedforsecurity=False)
    for name in sorted(used):
        found.update(texts[name])
    return found.hexdigest()[:16]


def _module(file: Path, package: Path) -> str:
    return str(file)[len(str(package.parent)) + 1 : -len(".py")].replace(os.sep, ".")


def _remove_unused(folder: Path) -> None:
    for old in folder.parent.glob("kernels-*"):
        with suppress(FileNotFoundError):  # another program may be cleaning up as well
            if old != folder and time.time() - old.stat().st_mtime > _KEPT_S:
                shutil.rmtree(old, ignore_errors=True)
