"""What the ELF file of an image holds, as GNU's binutils for Arm tell it."""

import os
import re
import subprocess
from pathlib import Path
from typing import NamedTuple


class Symbol(NamedTuple):
    """A function or a variable."""

    address: int
    size: int
    """In bytes."""
    name: str


class Instruction(NamedTuple):
    """An instruction as the disassembler writes it."""

    address: int
    name: str
    operands: str


def code_of(elf: Path) -> bytes:
    """The flash's contents from address 0.

    Raises:
        subprocess.CalledProcessError: it is no ELF file for this processor, here and below.
    """
    return _told("objcopy", "-O", "binary", "--remove-section=.uicr", elf, "/dev/stdout")


def configuration_of(elf: Path) -> bytes:
    """What the image writes into UICR, from PSELRESET[0] on."""
    return _told("objcopy", "-O", "binary", "--only-section=.uicr", elf, "/dev/stdout")


def symbols_of(elf: Path) -> list[Symbol]:
    """All that have a size, in the order of their addresses."""
    lines = _told("nm", "--print-size", "--numeric-sort", "--defined-only", elf).decode()
    found = re.findall(r"^([0-9a-f]+) ([0-9a-f]+) \w (\S+)$", lines, re.MULTILINE)
    return [Symbol(int(address, 16), int(size, 16), name) for address, size, name in found]


def instructions_of(elf: Path) -> list[Instruction]:
    """All instructions in the order of their addresses."""
    lines = _told("objdump", "--disassemble", elf).decode()
    found = re.findall(r"^ +([0-9a-f]+):\t[0-9a-f ]+\t([a-z]\S*)\t?([^;@\n]*)", lines, re.MULTILINE)
    return [Instruction(int(address, 16), name, operands) for address, name, operands in found]


def _told(tool: str, *words: str | Path) -> bytes:
    command = os.environ.get("CROSS", "arm-none-eabi-") + tool
    return subprocess.run([command, *words], capture_output=True, check=True).stdout
