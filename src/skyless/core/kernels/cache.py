"""Where compiled kernels are kept, and which parts of them are there.

The folder belongs to exactly these sources: the compiler notices a change of the kernel's own file but not of what it
calls, nor of constants from elsewhere, so a digest of all files with kernels, and of all that these import, stands in
its name. Folders of other sources are removed when they have not been used for long.

The first of these is used that can be written, or that cannot but holds kernels for this processor (an image):
``NUMBA_CACHE_DIR``, next to the sources, the user's cache, a private folder among the temporary ones.
"""

import hashlib
import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Final

from llvmlite.binding import get_host_cpu_features, get_host_cpu_name
from msgspec import Struct

ONLY_VARIABLE: Final = "SKYLESS_COMPILE_ONLY"
"""Environment variable: packages, with commas, whose kernels this program compiles; others run as plain Python.

Those with a minus are left out. So several programs compile parts of what one computation needs
(``processes.py``).
"""

_PACKAGE: Final = Path(__file__).parents[2]
_IMPORT: Final = re.compile(rb"from (skyless[\w.]*) import (\([^)]*\)|.*)")
_KEPT_S: Final = 7 * 86_400.0
"""Kernels of other sources are kept for a week after their last use: several versions may share a folder."""


class KernelFolder(Struct, frozen=True):
    """A folder of compiled kernels."""

    path: Path
    """Where exactly these sources' kernels are; None of it may exist."""
    key: str
    """Names compiler, interpreter, processor and where the sources are: kernels of others are of no use."""
    writable: bool
    temporary: bool
    """Whether the system may remove it at its next start."""

    def is_ready(self, part: str) -> bool:
        """Whether a part has been compiled for this processor."""
        return self._mark(part).is_file()

    def mark_ready(self, part: str) -> None:
        """Note that a part has been compiled."""
        with suppress(OSError):  # a full disk: it is compiled again next time
            self._mark(part).touch()

    def _mark(self, part: str) -> Path:
        return self.path / f"ready-{self.key}-{part}"


@cache
def kernel_folder() -> KernelFolder:
    """Where this program keeps compiled kernels; a folder that can be written exists."""
    if asked := os.environ.get("NUMBA_CACHE_DIR"):
        # absolute for the programs that this one starts, too: they may change their working folder
        os.environ["NUMBA_CACHE_DIR"] = str(Path(asked).absolute())
    name = f"kernels-{digest(_PACKAGE)}"
    found = choose_folder(_homes(), name, _key()) or _temporary_folder(name, _key())
    if found.writable:
        with suppress(OSError):
            os.utime(found.path)  # its time is that of its last use
            _remove_unused(found.path)
    return found


def choose_folder(homes: Iterable[Path], name: str, key: str) -> KernelFolder | None:
    """The first home whose folder can be written, or cannot but holds kernels for this key; None if there is none."""
    for home in homes:
        path = home / name
        with suppress(OSError):
            path.mkdir(parents=True, exist_ok=True)
        with suppress(OSError):  # a home that may not be searched
            if path.is_dir() and os.access(path, os.W_OK | os.X_OK):
                return KernelFolder(path, key, writable=True, temporary=False)
            if any(path.glob(f"ready-{key}-*")):
                return KernelFolder(path, key, writable=False, temporary=False)
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


def _temporary_folder(name: str, key: str) -> KernelFolder:
    """One folder for all programs of this user; another user's of that name is not trusted, as kernels are code."""
    home = Path(tempfile.gettempdir()) / f"skyless-{os.getuid() if hasattr(os, 'getuid') else 'kernels'}"
    try:
        home.mkdir(mode=0o700, exist_ok=True)
        found = home.lstat()
        if hasattr(os, "getuid") and (found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) & 0o022):
            home = Path(tempfile.mkdtemp(prefix="skyless-"))
            os.environ["NUMBA_CACHE_DIR"] = str(home)  # for the programs that this one starts
        (home / name).mkdir(exist_ok=True)
    except OSError:  # nothing can be written at all: every program compiles for itself
        return KernelFolder(home / name, key, writable=False, temporary=True)
    return KernelFolder(home / name, key, writable=True, temporary=True)


def digest(package: Path) -> str:
    """Digest of the files of the package ``skyless`` that hold kernels, and of all that these import."""
    texts = {_module(file, package): file.read_bytes() for file in sorted(package.rglob("*.py"))}
    wanted = [name for name, text in texts.items() if b"skyless.core.kernels.compiled" in text or ".kernels." in name]
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


def _key() -> str:
    processor = os.environ.get("NUMBA_CPU_NAME") or get_host_cpu_name()
    features = os.environ.get("NUMBA_CPU_FEATURES")
    if features is None:
        features = "" if processor == "generic" else get_host_cpu_features().flatten()
    words = (version("numba"), version("llvmlite"), sys.version, processor, features, str(_PACKAGE))
    return hashlib.sha1("\n".join(words).encode(), usedforsecurity=False).hexdigest()[:12]


def _remove_unused(folder: Path) -> None:
    for old in folder.parent.glob("kernels-*"):
        with suppress(FileNotFoundError):  # another program may be cleaning up as well
            if old != folder and time.time() - old.stat().st_mtime > _KEPT_S:
                shutil.rmtree(old, ignore_errors=True)
