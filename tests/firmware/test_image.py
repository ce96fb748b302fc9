"""The image that goes onto a board: it builds without a warning, is small and fast, and holds what it should."""

import re
import shutil
import subprocess

import pytest
from emulator.build import FIRMWARE, HAS_ARM_COMPILER, build
from firmware_stage import STACK_BYTES, needs_processor

from skyless.cli.nodes.flash import firmware
from skyless.core.native.library import SOURCE
from skyless.radio.dw1000.radio import SOURCES

pytestmark = pytest.mark.site

needs_arm = pytest.mark.skipif(not HAS_ARM_COMPILER, reason="gcc-arm-none-eabi or make is not installed")

MAX_FLASH, MAX_RAM = 96 * 1024, 48 * 1024


def run(*words, cwd=None):
    return subprocess.run(words, capture_output=True, text=True, check=True, cwd=cwd)


def cycles(text):
    """Microseconds by path, as a table states them."""
    return {path: float(most) for path, most in re.findall(r"^\| ([^|]+) \| (\d+) \|", text, re.MULTILINE)}


@needs_arm
def test_a_build_from_nothing_has_no_warning_starts_at_the_processors_vectors_and_stays_in_its_flash(tmp_path):
    """By the records of its Intel HEX file (Intel, Hexadecimal Object File Format, 1988)."""
    for name in ("Makefile", "dwm1001.ld", "source"):
        part = FIRMWARE / name
        (shutil.copytree if part.is_dir() else shutil.copy)(part, tmp_path / name)
    done = run("make", f"DRIVER={SOURCES}", f"CORE={SOURCE.parent}", cwd=tmp_path)
    assert done.stderr == ""
    flash, ram = map(int, re.search(r"flash (\d+) of 98304 bytes, RAM (\d+) of 49152", done.stdout).groups())
    assert 4000 < flash < MAX_FLASH
    assert 2048 < ram < MAX_RAM
    memory, base = {}, 0
    for line in (tmp_path / "build" / "skyless-dwm1001.hex").read_text("ascii").splitlines():
        raw = bytes.fromhex(line.removeprefix(":"))
        assert line.startswith(":")
        assert sum(raw) & 0xFF == 0
        count, offset, kind, data = raw[0], int.from_bytes(raw[1:3], "big"), raw[3], raw[4:-1]
        assert count == len(data)
        if kind in {2, 4}:
            base = int.from_bytes(data, "big") << (4 if kind == 2 else 16)
        elif kind == 0:
            memory.update(zip(range(base + offset, base + offset + count), data, strict=True))
    assert min(memory) == 0
    assert max(memory) < MAX_FLASH
    vectors = bytes(memory[at] for at in range(64))
    stack, *handlers = (int.from_bytes(vectors[at : at + 4], "little") for at in range(0, 64, 4))
    assert stack == 0x2000_0000 + STACK_BYTES  # below all variables: one that is too long ends in a fault
    assert stack % 8 == 0
    used = [handler for handler in handlers if handler]
    assert len(used) == 10
    assert all(handler & 1 and handler < max(memory) for handler in used)
    assert bytes(memory[at] for at in range(64, 88)) == b"skyless-dwm1001 unknown\0"


@needs_arm
def test_the_image_states_the_version_of_the_project():
    assert firmware(build("all").with_suffix(".hex"))


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


def test_sources_use_no_vendors_files():
    """Own register definitions; only headers that every compiler brings."""
    allowed = {"stdbool.h", "stddef.h", "stdint.h", "string.h"}
    for path in [*(FIRMWARE / "source").glob("*.[ch]"), *SOURCES.glob("*.[ch]")]:
        found = set(re.findall(r"#include <(.+?)>", path.read_text("utf-8")))
        assert found <= allowed, path.name


@needs_processor
@pytest.mark.statistical
def test_the_table_of_cycles_in_the_documents_is_what_the_present_firmware_needs():
    """And a reception takes less than the shortest slot leaves. Another compiler may change a figure a little."""
    from emulator.processor.cycle_table import cycle_table

    measured = cycles(cycle_table(build("all")))
    page = (FIRMWARE.parent / "docs" / "hardware.md").read_text("utf-8").partition("<!-- cycles")[2]
    expected = {path: pytest.approx(most, rel=0.1, abs=2) for path, most in measured.items()}
    renew = "python benchmarks/firmware.py cycles --write renews docs/hardware.md"
    assert cycles(page.partition("<!-- end -->")[0]) == expected, renew
    without, with_phase = (most for path, most in measured.items() if path.startswith("reception"))
    assert 100 < without < with_phase <= 400
    (latency,) = (most for path, most in measured.items() if "latency" in path)
    assert latency < 400
