"""Calls ``make -C firmware``, one at a time: tests that run at once share its folder."""

import fcntl
import os
import shutil
import subprocess
from pathlib import Path
from typing import Literal

FIRMWARE = Path(__file__).parents[1]
BUILD = FIRMWARE / "build"
_HAS_MAKE = shutil.which("make") is not None
HAS_HOST_COMPILER = _HAS_MAKE and shutil.which(os.environ.get("HOST_CC", "gcc")) is not None
HAS_ARM_COMPILER = _HAS_MAKE and shutil.which(os.environ.get("CROSS", "arm-none-eabi-") + "gcc") is not None

_RESULTS = {"all": "skyless-dwm1001.elf", "core": "core.elf", "host": "libskyless-board.so", "fuzz": "fuzz"}


def build(target: Literal["all", "core", "host", "fuzz"]) -> Path:
    """Bring a target of the Makefile up to date; where it is.

    Raises:
        RuntimeError: it cannot be built; the message has the compiler's.
    """
    BUILD.mkdir(exist_ok=True)
    with (BUILD / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = subprocess.run(["make", "-C", str(FIRMWARE), target], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"make -C firmware {target} fails:\n{done.stdout}{done.stderr}")
    return BUILD / _RESULTS[target]
