"""The image that goes onto a board: it builds without a warning, is small, and holds what it should."""

import re
import shutil
import subprocess

import pytest
from emulator.build import FIRMWARE, HAS_ARM_COMPILER, HAS_HOST_COMPILER, build

from skyless.radio.dw1000.driver import SOURCES

pytestmark = pytest.mark.site

needs_arm = pytest.mark.skipif(not HAS_ARM_COMPILER, reason="gcc-arm-none-eabi or make is not installed")

MAX_FLASH, MAX_RAM = 32 * 1024, 16 * 1024


def run(*words, cwd=None):
    return subprocess.run(words, capture_output=True, text=True, check=True, cwd=cwd)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A build from nothing: its folder, what was written, and what was complained about."""
    folder = tmp_path_factory.mktemp("firmware")
    for name in ("Makefile", "dwm1001.ld", "source"):
        part = FIRMWARE / name
        (shutil.copytree if part.is_dir() else shutil.copy)(part, folder / name)
    done = run("make", f"DRIVER={SOURCES}", cwd=folder)
    return folder / "build", done.stdout, done.stderr


@needs_arm
def test_it_builds_without_a_warning_and_says_its_sizes(built):
    folder, output, complaints = built
    assert complaints == ""
    assert (folder / "skyless-dwm1001.hex").is_file()
    flash, ram = map(int, re.search(r"flash (\d+) of 32768 bytes, RAM (\d+) of 16384", output).groups())
    assert 4000 < flash < MAX_FLASH
    assert 2048 < ram < MAX_RAM


@needs_arm
def test_there_is_no_floating_point_no_heap_and_no_recursion(built):
    folder, _, _ = built
    names = run("arm-none-eabi-nm", str(folder / "skyless-dwm1001.elf")).stdout
    assert not re.search(r"__aeabi_[fd]|malloc|sbrk|printf", names)
    text = run("arm-none-eabi-objdump", "-d", str(folder / "skyless-dwm1001.elf")).stdout
    assert not re.search(r"\tv(add|mul|ldr|mov|push)", text)
    calls, here = {}, ""
    for line in text.splitlines():
        if head := re.match(r"[0-9a-f]+ <(\w+)>:", line):
            here = head[1]
        elif call := re.search(r"\tb(?:l|\.w|\.n)?\t[0-9a-f]+ <(\w+)>", line):
            calls.setdefault(here, set()).add(call[1])

    def deepest(name, above=()):
        assert name not in above, f"{name} calls itself"
        return max([deepest(other, (*above, name)) for other in calls.get(name, ()) if other != name], default=0) + 1

    assert 3 < deepest("main") < 12


def records_of_hex(path):
    """Address and data of an Intel HEX file's records (Intel, Hexadecimal Object File Format, 1988)."""
    base = 0
    for line in path.read_text("ascii").splitlines():
        raw = bytes.fromhex(line.removeprefix(":"))
        assert line.startswith(":")
        assert sum(raw) & 0xFF == 0
        count, offset, kind, data = raw[0], int.from_bytes(raw[1:3], "big"), raw[3], raw[4:-1]
        assert count == len(data)
        if kind == 4:
            base = int.from_bytes(data, "big") << 16
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
    assert stack == 0x2000_0000 + 2048  # below all variables: one that is too long ends in a fault
    assert stack % 8 == 0
    used = [handler for handler in handlers if handler]
    assert len(used) == 10
    assert all(handler & 1 and handler < max(memory) for handler in used)


@pytest.mark.skipif(not HAS_HOST_COMPILER, reason="make and gcc are not installed")
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.statistical
def test_ten_million_random_bytes_and_any_chip_stop_nothing(seed):
    """With the address and undefined-behaviour sanitizers; what is checked stands in firmware/host/fuzz.c."""
    done = run(str(build("fuzz")), "10000000", str(seed))
    received, _, frames = map(int, re.findall(r"\d+", done.stdout)[:3])
    assert received >= 10_000_000
    assert frames > 1000


def test_the_fuzzer_says_what_it_needs():
    if not HAS_HOST_COMPILER:
        pytest.skip("make and gcc are not installed")
    done = subprocess.run([str(build("fuzz"))], capture_output=True, text=True, check=False)
    assert (done.returncode, "10000000" in done.stderr) == (2, True)


def test_sources_use_no_vendors_files():
    """Own register definitions; only headers that every compiler brings."""
    allowed = {"stdbool.h", "stddef.h", "stdint.h", "string.h"}
    for path in [*(FIRMWARE / "source").iterdir(), *SOURCES.iterdir()]:
        found = set(re.findall(r"#include <(.+?)>", path.read_text("utf-8")))
        assert found <= allowed, path.name
