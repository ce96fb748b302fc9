"""Small programs for the emulated processor."""

import subprocess
from importlib.util import find_spec
from pathlib import Path

import pytest
from emulator.build import FIRMWARE, HAS_ARM_COMPILER

needs_processor = pytest.mark.skipif(
    not HAS_ARM_COMPILER or find_spec("unicorn") is None,
    reason="gcc-arm-none-eabi, make or the package unicorn is not installed",
)


def build_program(folder, program, **macros):
    """An ELF file of tests/firmware/processor_programs.c."""
    elf = folder / f"{program}-{abs(hash(frozenset(macros.items()))):x}.elf"
    definitions = [f"-D{name}={value}" for name, value in {"PROGRAM": program, **macros}.items()]
    flags = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=soft", "-O2", "-ffreestanding", "-nostdlib", "-w"]
    paths = ["-I", FIRMWARE / "source", "-T", FIRMWARE / "dwm1001.ld"]
    program_file = Path(__file__).with_name("processor_programs.c")
    subprocess.run(["arm-none-eabi-gcc", *flags, *definitions, *paths, program_file, "-o", elf], check=True)
    return elf
