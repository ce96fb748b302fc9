"""Small programs for the emulated processor."""

import re
import subprocess
from importlib.util import find_spec
from pathlib import Path

import pytest
from emulator.build import FIRMWARE, HAS_ARM_COMPILER

from skyless.core.native.library import SOURCE
from skyless.radio.dw1000.radio import SOURCES

needs_processor = pytest.mark.skipif(
    not HAS_ARM_COMPILER or find_spec("unicorn") is None,
    reason="gcc-arm-none-eabi, make or the package unicorn is not installed",
)


STACK_BYTES = int(re.search(r"^STACK_BYTES = (\d+);", (FIRMWARE / "dwm1001.ld").read_text("utf-8"), re.MULTILINE)[1])
HARDWARE = ("startup", "main", "clock", "serial_port", "flash", "bluetooth", "link", "settings")
HARDWARE_FILES = [*((FIRMWARE / "source" / name).with_suffix(".c") for name in HARDWARE), SOURCES / "dw1000.c"]


def build_board(folder, program, **macros):
    """An ELF file of tests/firmware/board_programs.c on the firmware's hardware functions."""
    return build_program(folder, program, "board_programs.c", HARDWARE_FILES, **macros)


def build_program(folder, program, source="processor_programs.c", others=(), **macros):
    """An ELF file of one of the programs in tests/firmware."""
    elf = folder / f"{program}-{abs(hash(frozenset(macros.items()))):x}.elf"
    definitions = [f"-D{name}={value}" for name, value in {"PROGRAM": program, **macros}.items()]
    flags = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-O2", "-ffreestanding"]
    flags += ["-nostdlib", "-w", "-fno-tree-loop-distribute-patterns", "-std=gnu11"]
    paths = ["-I", FIRMWARE / "source", "-I", SOURCES, "-I", SOURCE.parent, "-T", FIRMWARE / "dwm1001.ld"]
    definitions += ["-DSKYLESS_FLOAT", "-include", FIRMWARE / "source" / "core_sizes.h"]
    files = [Path(__file__).with_name(source), *others]
    subprocess.run(["arm-none-eabi-gcc", *flags, *definitions, *paths, *files, "-lgcc", "-o", elf], check=True)
    return elf
