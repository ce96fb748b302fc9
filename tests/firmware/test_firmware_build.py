"""The image that goes onto a board: it builds without a warning, is small, and holds what it should."""

import re
import shutil
import subprocess

import pytest
from emulator.build import FIRMWARE, HAS_ARM_COMPILER, build
from processor_stage import STACK_BYTES

from skyless.core.native.library import SOURCE
from skyless.radio.dw1000.radio import SOURCES

pytestmark = pytest.mark.site

needs_arm = pytest.mark.skipif(not HAS_ARM_COMPILER, reason="gcc-arm-none-eabi or make is not installed")

MAX_FLASH, MAX_RAM = 96 * 1024, 48 * 1024


def run(*words, cwd=None):
    return subprocess.run(words, capture_output=True, text=True, check=True, cwd=cwd)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A build from nothing: its folder, what was written, and what was complained about."""
    folder = tmp_path_factory.mktemp("firmware")
    for name in ("Makefile", "dwm1001.ld", "source"):
        part = FIRMWARE / name
        (shutil.copytree if part.is_dir() else shutil.copy)(part, folder / name)
    done = run("make", f"DRIVER={SOURCES}", f"CORE={SOURCE.parent}", cwd=folder)
    return folder / "build", done.stdout, done.stderr


@needs_arm
def test_it_builds_without_a_warning_and_says_its_sizes(built):
    folder, output, complaints = built
    assert complaints == ""
    assert (folder / "skyless-dwm1001.hex").is_file()
    flash, ram = map(int, re.search(r"flash (\d+) of 98304 bytes, RAM (\d+) of 49152", output).groups())
    assert 4000 < flash < MAX_FLASH
    assert 2048 < ram < MAX_RAM


@needs_arm
@pytest.mark.parametrize(("image", "deep"), [("all", 24), ("core", 16)])
def test_there_is_no_arithmetic_without_instructions_no_heap_and_no_recursion(image, deep):
    elf = str(build(image))
    names = run("arm-none-eabi-nm", elf).stdout
    assert not re.search(r"__aeabi_(d|f2d|\w+2d|f2u?lz)|malloc|sbrk|printf", names)
    text = run("arm-none-eabi-objdump", "-d", elf).stdout
    calls, here = {}, ""
    for line in text.splitlines():
        if head := re.match(r"[0-9a-f]+ <(\w+)>:", line):
            here = head[1]
        elif call := re.search(r"\tb(?:l|\.w|\.n)?\t[0-9a-f]+ <(\w+)>", line):
            calls.setdefault(here, set()).add(call[1])

    def deepest(name, above=()):
        assert name not in above, f"{name} calls itself"
        return max([deepest(other, (*above, name)) for other in calls.get(name, ()) if other != name], default=0) + 1

    assert 3 < deepest("main") < deep


def records_of_hex(path):
    """Address and data of an Intel HEX file's records (Intel, Hexadecimal Object File Format, 1988)."""
    base = 0
    for line in path.read_text("ascii").splitlines():
        raw = bytes.fromhex(line.removeprefix(":"))
        assert line.startswith(":")
        assert sum(raw) & 0xFF == 0
        count, offset, kind, data = raw[0], int.from_bytes(raw[1:3], "big"), raw[3], raw[4:-1]
        assert count == len(data)
        if kind in {2, 4}:
            base = int.from_bytes(data, "big") << (4 if kind == 2 else 16)
        elif kind == 0:
            yield base + offset, data


@needs_arm
def test_the_image_starts_at_the_processors_vectors_and_stays_in_its_flash(built):
    folder, _, _ = built
    memory = {}
    for at, data in records_of_hex(folder / "skyless-dwm1001.hex"):
        memory.update(zip(range(at, at + len(data)), data, strict=True))
    assert min(memory) == 0
    assert max(memory) < MAX_FLASH
    stack, *handlers = (
        int.from_bytes(bytes(memory[at + byte] for byte in range(4)), "little") for at in range(0, 64, 4)
    )
    assert stack == 0x2000_0000 + STACK_BYTES  # below all variables: one that is too long ends in a fault
    assert stack % 8 == 0
    used = [handler for handler in handlers if handler]
    assert len(used) == 10
    assert all(handler & 1 and handler < max(memory) for handler in used)


def test_sources_use_no_vendors_files():
    """Own register definitions; only headers that every compiler brings."""
    allowed = {"stdbool.h", "stddef.h", "stdint.h", "string.h"}
    for path in [*(FIRMWARE / "source").glob("*.[ch]"), *SOURCES.glob("*.[ch]")]:
        found = set(re.findall(r"#include <(.+?)>", path.read_text("utf-8")))
        assert found <= allowed, path.name
