"""The estimator on the emulated chip: calls of the image that ``make -C firmware core`` builds."""

import ctypes

from emulator.build import build
from emulator.processor.cortex_m4 import Core
from emulator.processor.elf import symbols_of

_SYSTEM_CONTROL = (0xE000E000, 0x1000)
_FLASH_CONTROL = (0x4001E000, 0x1000)
_IDENTIFICATION = (0xF0000000, 0x1000)
_CPACR, _ICACHECNF = 0xE000ED88, 0x4001E540
_FOREVER = 1 << 62


class BoardCore:
    """The processor with the core, one call after the other; records have the board's layout."""

    def __init__(self):
        self.elf = build("core")
        self._at = {name: at for at, _, name in symbols_of(self.elf)}
        self.processor = Core(self.elf, [_FLASH_CONTROL, _SYSTEM_CONTROL, _IDENTIFICATION], self._load, self._store)
        assert self.processor.run(_FOREVER) == "sleep"

    def _load(self, _address, _size):
        return 0

    def _store(self, address, _size, value):
        if address == _CPACR:
            self.processor.use_fpu(value >> 20 & 0xF == 0xF)
        elif address == _ICACHECNF:
            self.processor.use_cache(bool(value & 1))

    def put_state(self, state):
        self.processor.store(self._at["core_state"], bytes(state))

    def state(self, made):
        return made.from_buffer_copy(self.processor.load(self._at["core_state"], ctypes.sizeof(made)))

    def process(self, packet, relays):
        """What becomes of a packet, and the cycles that it takes."""
        self.processor.store(self._at["core_packet"], bytes(packet))
        self.processor.store(self._at["core_relays"], bytes(relays))
        before = self.processor.cycles
        stopped = self.processor.run(_FOREVER)
        assert (stopped, self.processor.faults) == ("sleep", [])
        outcome = int.from_bytes(self.processor.load(self._at["core_outcome"], 4), "little", signed=True)
        return outcome, self.processor.cycles - before

    def cycles_by_function(self):
        """Since they were last asked for, the most first."""
        found = self.processor.cycles_by_function()
        self.processor.forget_spent()
        return found
