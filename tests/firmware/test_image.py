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

MAX_FLASH, MAX_RAM, MAX_STACK = 110 * 1000, 58 * 1000, 0.75 * STACK_BYTES  # the rest: a fault's frame, other compilers


def run(*words, cwd=None):
    return subprocess.run(words, capture_output=True, text=True, check=True, cwd=cwd)


def sizes(said):
    """Flash, RAM and the deepest stack by image, as ``make`` says them."""
    line = r"(\S+): flash (\d+) of 262144 bytes, RAM (\d+) of 65536, of it stack (\d+) of 12288"
    return {name: [int(size) for size in found] for name, *found in re.findall(line, said)}


def cycles(text):
    """Microseconds by path, as a table states them."""
    return {path: float(most) for path, most in re.findall(r"^\| ([^|]+) \| (\d+) \|", text, re.MULTILINE)}


@needs_arm
def test_a_build_from_nothing_has_no_warning_starts_at_the_processors_vectors_and_stays_in_its_flash(tmp_path):
    """By the records of its Intel HEX file (Intel, Hexadecimal Object File Format, 1988)."""
    for name in ("Makefile", "dwm1001.ld", "stack.awk", "source"):
        part = FIRMWARE / name
        (shutil.copytree if part.is_dir() else shutil.copy)(part, tmp_path / name)
    done = run("make", f"DRIVER={SOURCES}", f"CORE={SOURCE.parent}", cwd=tmp_path)
    assert done.stderr == ""
    ((flash, ram, stack),) = sizes(done.stdout).values()
    assert 4000 < flash < MAX_FLASH
    assert STACK_BYTES < ram < MAX_RAM
    assert 1000 < stack < MAX_STACK
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
    uicr = [memory.pop(at) for at in range(0x1000_1200, 0x1000_1208)]
    assert uicr[::4] == [21, 21]  # the reset pin, twice; a word for the debug port would lock it on revisions 1 and 2
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
@pytest.mark.parametrize("image", ["all", "core"])
def test_there_is_no_arithmetic_without_instructions_and_no_heap(image):
    names = run("arm-none-eabi-nm", str(build(image))).stdout
    assert not re.search(r"__aeabi_(d|f2d|\w+2d|f2u?lz)|malloc|sbrk|printf", names)


@needs_arm
def test_the_table_of_sizes_in_the_readme_is_true_within_3_percent():
    build("core")
    said = run("make", "-s", "-C", str(build("all").parents[1]), "sizes").stdout
    table = (FIRMWARE / "README.md").read_text("utf-8")
    compilers = re.findall(r"deepest stack, gcc (\d+)", table)
    used = run("arm-none-eabi-gcc", "-dumpversion").stdout.partition(".")[0]
    at = 2 * compilers.index(used if used in compilers else compilers[-1])
    rows = re.findall(r"^\| ([\w-]+) \| ([\d,| ]+) \|$", table, re.MULTILINE)
    stated = {name: [int(cell) for cell in cells.replace(",", "").split("|")] for name, cells in rows}
    chosen = {name: [row[at + 1], row[0], row[at + 2]] for name, row in stated.items()}
    assert sizes(said) == {name: pytest.approx(row, rel=0.03) for name, row in chosen.items()}, said


OF_THE_HARDWARE = """
static void flat(void) {}
static void deep(void) { volatile char a[2000]; a[0] = 1; }
static const struct hardware { void (*one)(void), (*two)(void); } HARDWARE = {
    .one = flat,
    .two = deep,
};
void reset_handler(const struct hardware *hardware) { volatile char a[300]; a[0] = 1; hardware->one(); }"""


@needs_arm
@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("void f(int n) { if (n) f(n - 1); } void reset_handler(void) { f(3); }", "f calls itself"),
        ("void (*p)(void); void reset_handler(void) { p(); }", "reset_handler calls through a pointer: main.c:1:"),
        ("void f(char *a) { *a = 1; } void reset_handler(int n) { char a[n]; f(a); }", "has a frame that grows"),
        ("void f(void); void reset_handler(void) { f(); }", "f has no frame that is known"),
        (OF_THE_HARDWARE, "23"),
    ],
)
def test_a_stack_without_a_bound_is_refused_and_any_call_of_the_hardware_counts_as_its_deepest(tmp_path, source, said):
    (tmp_path / "main.c").write_text(source)
    run("arm-none-eabi-gcc", "-fcallgraph-info=su", "-c", "main.c", cwd=tmp_path)
    words = ["awk", "-f", str(FIRMWARE / "stack.awk"), "main.c", "main.ci"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert said in done.stderr or done.stdout.startswith(said)
    assert bool(done.returncode) is bool(done.stderr) is not bool(done.stdout)


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
