"""A Cortex-M4 that executes an image: Unicorn with cycle counts, sleep and faults.

Interrupts are never taken: the firmware keeps PRIMASK set, and an interrupt only ends WFI. One that would be taken is
an ``EmulationError``. Faults go to the HardFault handler with the status registers of the System Control Block set; a
fault in that handler is a lockup. Exception returns are not modelled, since the handler ends in a reset.
"""

import ctypes
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Final, Literal

from unicorn import (
    UC_ARCH_ARM,
    UC_HOOK_INTR,
    UC_HOOK_MEM_INVALID,
    UC_MEM_FETCH_UNMAPPED,
    UC_MODE_MCLASS,
    UC_MODE_THUMB,
    UC_PROT_ALL,
    UC_PROT_EXEC,
    UC_PROT_READ,
    Uc,
    UcError,
)
from unicorn import arm_const as arm

from emulator.processor import cycles as c
from emulator.processor.elf import code_of, symbols_of
from emulator.processor.unicorn_library import hook_blocks, map_window

RAM_BASE: Final = 0x20000000
RAM_BYTES: Final = 64 * 1024
FLASH_BYTES: Final = 512 * 1024

_WFI: Final = b"\x30\xbf"
_NEVER: Final = 0xFFFFFFFE
_GARBAGE: Final = 0xA5
"""RAM after power-on; on hardware its contents are unknown."""
_HARD_FAULT_VECTOR: Final = 12

_FORCED: Final = 1 << 30
_INSTRUCTION_BUS_ERROR: Final = 1 << 8
_PRECISE_BUS_ERROR: Final = 1 << 9 | 1 << 15
_UNDEFINED_INSTRUCTION: Final = 1 << 16
_NO_COPROCESSOR: Final = 1 << 19

Stop = Literal["limit", "sleep", "lockup"]
Read = Callable[[int, int], int]
"""Address and bytes of a load from a peripheral; its value."""
Write = Callable[[int, int, int], None]
"""Address, bytes and value of a store to a peripheral."""


class EmulationError(Exception):
    """The firmware used something that the emulator does not model, or that hardware has not."""


class Core:
    """Processor, flash and RAM. ``windows`` are base and size of what ``read`` and ``write`` answer for."""

    def __init__(self, elf: Path, windows: list[tuple[int, int]], read: Read, write: Write) -> None:
        self.faults: list[str] = []
        """Every fault since power-on, with the address of the instruction."""
        self.hfsr = self.cfsr = self.bfar = 0
        self._elf, self._windows, self._read, self._write = elf, windows, read, write
        self._code = code_of(elf)
        self.state = c.make_state(elf, len(self._code))
        self.ram = (ctypes.c_uint8 * RAM_BYTES)()
        self._in_fault = False
        self.reset(keep_ram=False)

    # Time

    @property
    def cycles(self) -> int:
        """Cycles of the 64 MHz clock since power-on, sleep included."""
        return self.state.item(c.CYCLES)

    @cycles.setter
    def cycles(self, cycles: int) -> None:
        self.state[c.CYCLES] = cycles

    def stop_at(self, cycles: int) -> None:
        """Stop the present run there at the latest, at the next end of a block."""
        self.state[c.LIMIT] = min(self.state[c.LIMIT], cycles)

    def spend(self, cycles: int) -> None:
        """Let the processor wait."""
        self.state[c.CYCLES] += cycles

    def cycles_by_function(self) -> dict[str, int]:
        """Cycles spent in each function since they were last forgotten, waits for peripherals apart; the most first."""
        spent = c.spent_at(self.state)
        found = [(int(spent[at >> 1 : (at + size) >> 1].sum()), name) for at, size, name in symbols_of(self._elf)]
        return {name: cycles for cycles, name in sorted(found, reverse=True) if cycles}

    def forget_spent(self) -> None:
        """Count the cycles of functions from now on."""
        c.spent_at(self.state)[:] = 0

    def use_cache(self, on: bool) -> None:
        """Switch the instruction cache."""
        self.state[c.CACHE_ON] = int(on)
        c.forget_fetched(self.state)

    def use_fpu(self, on: bool) -> None:
        """Switch the floating-point unit, without which its instructions are a fault."""
        self.state[c.FPU] = c.FPU_ON if on else c.FPU_OFF

    # Registers and memory

    @property
    def pc(self) -> int:
        """Program counter; within a run that of the present block."""
        return int(self._uc.reg_read(arm.UC_ARM_REG_PC)) & ~1

    @property
    def masks_interrupts(self) -> bool:
        """Whether PRIMASK is set."""
        return bool(self._uc.reg_read(arm.UC_ARM_REG_PRIMASK))

    @property
    def fpu_flags(self) -> int:
        """FPSCR's flags of exceptions."""
        return int(self._uc.reg_read(arm.UC_ARM_REG_FPSCR)) & 0x9F

    def register(self, number: int) -> int:
        """R0 to R12, SP (13) and LR (14)."""
        named = {13: arm.UC_ARM_REG_SP, 14: arm.UC_ARM_REG_LR}
        return int(self._uc.reg_read(named.get(number, arm.UC_ARM_REG_R0 + number)))

    def load(self, address: int, size: int) -> bytes:
        """Bytes of the RAM, as DMA reads them; EmulationError outside it."""
        at = self._in_ram(address, size)
        return bytes(self.ram[at : at + size])

    def store(self, address: int, data: bytes) -> None:
        """Bytes into the RAM, as DMA writes them; EmulationError outside it."""
        at = self._in_ram(address, len(data))
        ctypes.memmove(ctypes.addressof(self.ram) + at, data, len(data))

    def _in_ram(self, address: int, size: int) -> int:
        at = address - RAM_BASE
        if at < 0 or at + size > RAM_BYTES:
            raise EmulationError(
                f"DMA of {size} bytes at 0x{address:08x}, behind PC 0x{self.pc:x}: it reaches RAM only"
            )
        return at

    @property
    def unused_stack_bytes(self) -> int:
        """What lies between the data and the stack's deepest end since power-on."""
        stack_top = struct.unpack_from("<I", self._code)[0] - RAM_BASE
        return max(map(len, re.split(rb"[^%c]" % _GARBAGE, bytes(self.ram[:stack_top]))))

    # Running

    def reset(self, *, keep_ram: bool) -> None:
        """Begin at the reset vector."""
        if not keep_ram:
            ctypes.memset(self.ram, _GARBAGE, RAM_BYTES)
        self._kept: list[object] = []
        """What the engine calls."""
        uc = self._uc = Uc(UC_ARCH_ARM, UC_MODE_THUMB | UC_MODE_MCLASS)
        uc.ctl_set_cpu_model(arm.UC_CPU_ARM_CORTEX_M4)
        flash_bytes = min(FLASH_BYTES, *(base for base, _ in self._windows))
        uc.mem_map(0, flash_bytes, UC_PROT_READ | UC_PROT_EXEC)
        uc.mem_write(0, self._code + b"\xff" * (flash_bytes - len(self._code)))
        uc.mem_map_ptr(RAM_BASE, RAM_BYTES, UC_PROT_ALL, ctypes.addressof(self.ram))
        for base, size in self._windows:
            self._map_window(base, size)
        hook_blocks(uc, c.block_hook(), self.state.ctypes.data)
        uc.hook_add(UC_HOOK_INTR, self._on_exception)
        uc.hook_add(UC_HOOK_MEM_INVALID, self._on_invalid_access)
        self._error: Exception | None = None
        self._exception: str | None = None
        self._invalid: tuple[int, int] | None = None
        self._in_fault = False
        self.hfsr = self.cfsr = self.bfar = 0
        stack, start = struct.unpack_from("<II", self._code)
        uc.reg_write(arm.UC_ARM_REG_SP, stack)
        self._next = start & ~1
        self.state[c.BLOCK_END] = -1
        self.use_cache(False)
        self.use_fpu(False)

    def _map_window(self, base: int, size: int) -> None:
        def load(offset: int, width: int) -> int:
            self.state[c.CYCLES] += c.PERIPHERAL_WAIT_CYCLES
            try:
                return self._read(base + offset, width)
            except Exception as error:  # noqa: BLE001 - raised again when the engine has stopped
                self._fail(error)
                return 0

        def store(offset: int, width: int, value: int) -> None:
            self.state[c.CYCLES] += c.PERIPHERAL_WAIT_CYCLES
            try:
                self._write(base + offset, width, value)
            except Exception as error:  # noqa: BLE001
                self._fail(error)

        self._kept.append(map_window(self._uc, base, size, load, store))

    def _fail(self, error: Exception) -> None:
        self._error = self._error or error
        self.stop_at(0)

    def run(self, limit: int) -> Stop:
        """Execute until the count of cycles reaches a limit (or a few cycles more), or the processor sleeps."""
        self.state[c.LIMIT] = limit
        while self.state[c.CYCLES] < self.state[c.LIMIT]:
            error: UcError | None = None
            try:
                self._uc.emu_start(self._next | 1, _NEVER)
            except UcError as caught:
                error = caught
            self._next = self.pc
            if self._error is not None:
                failed, self._error = self._error, None
                raise failed
            if error is not None or self._exception is not None or self.state[c.FPU] == c.FPU_REFUSED:
                if not self._enter_fault(error):
                    return "lockup"
            elif self._next == self.state[c.BLOCK_END] and self._code[self._next - 2 : self._next] == _WFI:
                return "sleep"
        return "limit"

    def _on_exception(self, uc: Uc, number: int, _data: object) -> None:
        self._exception = f"exception {number}"
        uc.emu_stop()

    def _on_invalid_access(self, _uc: Uc, access: int, address: int, _size: int, _value: int, _data: object) -> bool:
        self._invalid = access, address
        return False

    def _enter_fault(self, error: UcError | None) -> bool:
        """Record the fault and enter the HardFault handler; False where the processor locks up."""
        at, invalid = self._next, self._invalid
        is_refused = self.state[c.FPU] == c.FPU_REFUSED
        what = self._exception or ("the floating-point unit is off" if is_refused else str(error))
        self._exception = self._invalid = None
        self.hfsr |= _FORCED
        if is_refused:
            self.cfsr |= _NO_COPROCESSOR
            self.use_fpu(False)
        elif invalid is None:
            self.cfsr |= _UNDEFINED_INSTRUCTION
        elif invalid[0] == UC_MEM_FETCH_UNMAPPED:
            self.cfsr |= _INSTRUCTION_BUS_ERROR
        else:
            self.cfsr |= _PRECISE_BUS_ERROR
            self.bfar = invalid[1]
        place = "" if invalid is None else f", address 0x{invalid[1]:08x}"
        self.faults.append(f"{what} at PC 0x{at:08x}{place}")
        stack = self.register(13) - 32
        if self._in_fault or not RAM_BASE <= stack <= RAM_BASE + RAM_BYTES - 32:
            return False
        self._in_fault = True
        status = int(self._uc.reg_read(arm.UC_ARM_REG_XPSR))
        pushed = [*(self.register(n) for n in (0, 1, 2, 3, 12, 14)), at, status]
        self.store(stack, struct.pack("<8I", *pushed))
        self._uc.reg_write(arm.UC_ARM_REG_SP, stack)
        self._uc.reg_write(arm.UC_ARM_REG_LR, 0xFFFFFFF9)
        self._uc.reg_write(arm.UC_ARM_REG_XPSR, 0x01000000)  # no IT block goes on in the handler
        self._next = int.from_bytes(self._code[_HARD_FAULT_VECTOR : _HARD_FAULT_VECTOR + 4], "little") & ~1
        self.spend(12)
        return True
