"""RADIO, as far as it sends packets: what it puts on the air follows bit by bit from its registers and the RAM."""

from collections.abc import Callable, Iterator
from typing import Final

from msgspec import Struct

from emulator.processor.peripherals import Peripheral, System

_MICROSECOND: Final = 64
"""Cycles."""


class OnAir(Struct, frozen=True):
    """A packet that has left the antenna."""

    begin_cycles: int
    frequency_mhz: int
    txpower: int
    """As in the register."""
    bits: tuple[int, ...]
    """From the preamble on, in the order of the air; one takes 1 µs."""


class Radio(Peripheral):
    """One packet for each TXEN, in the mode BLE_1Mbit with the shortcuts READY_START and END_DISABLE.

    ``has_crystal`` says whether the fast crystal runs, without which the carrier is off.
    """

    base = 0x40001000
    irq = 1

    def __init__(self, system: System, has_crystal: Callable[[], bool], send: Callable[[OnAir], None]) -> None:
        # SHORTS, what describes packets, their check and whitening, MODECNF0.
        registers = (0x200, *range(0x504, 0x540, 4), 0x554, 0x650)
        super().__init__(system, tasks={0x000: self.enable}, events=(0x110,), registers=registers)  # TXEN, DISABLED
        self._has_crystal, self._send = has_crystal, send
        self.is_busy = False

    def enable(self) -> None:
        """Ramp up, send, and go off."""
        if self.is_busy:
            self.system.misuse["radio-enabled-while-busy"] += 1
            return
        if not self._has_crystal():
            self.system.misuse["radio-without-crystal"] += 1
        if self.registers[0x510] != 3 or self.registers[0x200] != 3:
            self.system.misuse["radio-in-another-mode"] += 1
            return
        self.is_busy = True
        begin = self.system.cycles + (40 if self.registers[0x650] & 1 else 140) * _MICROSECOND
        packet = OnAir(begin, 2400 + self.registers[0x508], self.registers[0x50C], tuple(self._bits()))
        self.system.plan(begin + len(packet.bits) * _MICROSECOND, lambda: self._end(packet))

    def _end(self, packet: OnAir) -> None:
        if tuple(self._bits()) != packet.bits:
            self.system.misuse["radio-changed-while-sending"] += 1
        self._send(packet)
        self.is_busy = False
        self.happen(0x110)

    def _bits(self) -> Iterator[int]:
        """Preamble, address, then S0, LENGTH, payload and check, which are whitened."""
        registers = self.registers
        base_bytes = registers[0x518] >> 16 & 7
        address = registers[0x51C].to_bytes(4, "little")[4 - base_bytes :] + bytes((registers[0x524] & 0xFF,))
        address_bits = _bits_of(address)
        for at in range(8):
            yield at & 1 ^ address_bits[0]
        yield from address_bits
        pointer, s0_bytes, length_bits = registers[0x504], registers[0x514] >> 8 & 1, registers[0x514] & 15
        head = self.system.load(pointer, s0_bytes + 1)
        size = min(head[-1] & ((1 << length_bits) - 1), registers[0x518] & 0xFF)
        body = _bits_of(head[:s0_bytes]) + _bits_of(head[-1:])[:length_bits]
        body += _bits_of(self.system.load(pointer + len(head), size))
        skips_address = registers[0x534] >> 8 & 1
        body += self._check(body if skips_address else address_bits + body)
        state = registers[0x554] & 0x3F | 0x40
        for bit in body:
            yield bit ^ (state & 1 if registers[0x518] >> 25 & 1 else 0)
            state = state >> 1 ^ (0x44 if state & 1 else 0)

    def _check(self, bits: list[int]) -> list[int]:
        """The remainder by CRCPOLY, from CRCINIT, its highest bit first."""
        width = 8 * (self.registers[0x534] & 3)
        check = self.registers[0x53C]
        for bit in bits:
            carry = check >> width - 1 & 1 ^ bit
            check = check << 1 & (1 << width) - 1 ^ (self.registers[0x538] if carry else 0)
        return [check >> at & 1 for at in reversed(range(width))]


def _bits_of(data: bytes) -> list[int]:
    """Low bits first."""
    return [byte >> at & 1 for byte in data for at in range(8)]
