"""The chip's registers as octets, and SPI transactions on them (DW1000 User Manual v2.12, 2.2.1.2, pp. 11-13)."""

from collections import Counter

from msgspec import Struct

from skyless.simulation.dw1000.registers import ALL_REGISTERS, FILE_LENGTHS, Register


class Access(Struct, frozen=True):
    """A transaction's header."""

    is_write: bool
    file: int
    sub: int
    octets: int
    """How long the header is."""


def decode_header(out: bytes) -> Access | None:
    """Header of one to three octets: bit 7 writes, bit 6 announces a sub-address of 7 or, with its bit 7, of 15 bits.

    None where the transaction ends before its header.
    """
    if not out:
        return None
    is_write, file = bool(out[0] & 0x80), out[0] & 0x3F
    if not out[0] & 0x40:
        return Access(is_write, file, 0, 1)
    if len(out) < 2:
        return None
    if not out[1] & 0x80:
        return Access(is_write, file, out[1], 2)
    if len(out) < 3:
        return None
    return Access(is_write, file, (out[1] & 0x7F) | out[2] << 7, 3)


class Memory:
    """All register files; what is reserved reads as 0."""

    def __init__(self, misuse: Counter[str]) -> None:
        self._misuse = misuse
        self._files = {file: bytearray(length) for file, length in FILE_LENGTHS.items()}
        self._fixed = {file: bytearray(length) for file, length in FILE_LENGTHS.items()}
        for one in ALL_REGISTERS.values():
            if one.access == "RO":
                self._fixed[one.file][one.sub : one.sub + one.length] = b"\1" * one.length
        self.reset()

    def reset(self) -> None:
        """All registers as after power-on."""
        for octets in self._files.values():
            octets[:] = bytes(len(octets))
        for one in ALL_REGISTERS.values():
            if one.reset:
                self.set(one, one.reset)

    def get(self, register: Register) -> int:
        """A register's value."""
        octets = self._files[register.file]
        return int.from_bytes(octets[register.sub : register.sub + register.length], "little")

    def set(self, register: Register, value: int) -> None:
        """Set a register from within the chip."""
        value &= (1 << 8 * register.length) - 1
        octets = value.to_bytes(register.length, "little")
        self._files[register.file][register.sub : register.sub + register.length] = octets

    def fill(self, register: Register, octets: bytes) -> None:
        """Set the first octets of a buffer from within the chip."""
        self._files[register.file][register.sub : register.sub + len(octets)] = octets

    def octets(self, register: Register) -> bytes:
        """A register's octets, lowest first."""
        return bytes(self._files[register.file][register.sub : register.sub + register.length])

    def read(self, file: int, sub: int, length: int) -> bytes:
        """What the host reads."""
        octets = self._files.get(file)
        if octets is None or sub + length > len(octets):
            self._misuse["read-beyond-register"] += 1
        return bytes(octets[sub : sub + length] if octets is not None else b"").ljust(length, b"\0")

    def write(self, file: int, sub: int, data: bytes) -> None:
        """What the host writes, but where a register is read-only; it must not write beyond a register (UM p. 11)."""
        octets = self._files.get(file)
        if octets is None or sub + len(data) > len(octets):
            self._misuse["write-beyond-register"] += 1
            return
        fixed = self._fixed[file]
        for at, octet in enumerate(data, sub):
            if not fixed[at]:
                octets[at] = octet
