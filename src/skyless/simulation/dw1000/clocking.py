"""Clocks, reset, microcode and one-time memory of the chip, from the DW1000 User Manual v2.12."""

from collections import Counter
from collections.abc import Callable
from typing import Final

from skyless.simulation.dw1000 import bits
from skyless.simulation.dw1000 import registers as r
from skyless.simulation.dw1000.measures import Senses
from skyless.simulation.dw1000.memory import Memory

LOCK_S: Final = 15e-6
"""Until the PLL has locked after a reset; the manual tells no guaranteed figure, drivers wait for CPLOCK."""
LOAD_S: Final = 150e-6
"""Until the microcode is loaded (UM 2.5.5.10: table 4)."""
SLOW_HZ: Final = 3_000_000
"""Fastest SPI while the chip runs on the crystal (UM 2.3.2: INIT)."""
FAST_HZ: Final = 20_000_000


class Clocking:
    """What must have happened before the chip can send or receive. ``seconds`` is any clock that runs on."""

    def __init__(self, memory: Memory, misuse: Counter[str], seconds: Callable[[], float], senses: Senses) -> None:
        self._memory, self._misuse, self._seconds = memory, misuse, seconds
        self.senses = senses
        self._lock_s = seconds() + LOCK_S
        self._loaded_s: float | None = None
        self.in_reset = False

    def restart(self) -> None:
        """As after power-on or a reset: nothing is loaded, the PLL begins to lock."""
        self._loaded_s = None
        self._lock_s = self._seconds() + LOCK_S

    @property
    def locked(self) -> bool:
        """Whether the chip runs on its PLL."""
        forced = self._memory.get(r.PMSC_CTRL0) & bits.SYSCLKS == bits.SYSCLKS_XTI
        return not (forced or self.in_reset) and self._seconds() >= self._lock_s

    @property
    def pll_has_locked(self) -> bool:
        """CPLOCK: the PLL may have locked while the crystal is still forced."""
        return not self.in_reset and self._seconds() >= self._lock_s

    @property
    def microcode_loaded(self) -> bool:
        """Whether the leading edge is searched for."""
        return self._loaded_s is not None and self._seconds() >= self._loaded_s

    def takes(self, hz: int) -> bool:
        """Whether a transfer at that rate arrives unspoilt."""
        return hz <= (FAST_HZ if self.locked else SLOW_HZ)

    def write_pmsc(self) -> int | None:
        """Follow PMSC_CTRL0; returns SOFTRESET where it resets something."""
        kind = self._memory.get(r.PMSC_CTRL0) >> bits.SOFTRESET_SHIFT
        if kind == bits.SOFTRESET_ALL and not self.in_reset:
            if self._memory.get(r.PMSC_CTRL0) & bits.SYSCLKS != bits.SYSCLKS_XTI:
                self._misuse["reset-not-on-crystal"] += 1  # UM 7.2.50.1
            self.in_reset = True
            return kind
        if kind == bits.SOFTRESET_NONE and self.in_reset:
            self.in_reset = False
            self.restart()
        return kind if kind == bits.SOFTRESET_RX else None

    def write_otp(self) -> None:
        """Follow OTP_CTRL: read a word, or load the microcode (UM 6.3.2, 2.5.5.10)."""
        control = self._memory.get(r.OTP_CTRL)
        if control & bits.OTPREAD:
            address = self._memory.get(r.OTP_ADDR) & 0x7FF
            self._memory.put(r.OTP_RDAT, self.senses.otp().get(address, 0))
        if control & bits.LDELOAD:
            if self._memory.get(r.PMSC_CTRL0) & 0xFFFF == bits.PMSC_FOR_LDE:
                self._loaded_s = self._seconds() + LOAD_S
            else:
                self._misuse["microcode-without-its-clock"] += 1
        self._memory.put(r.OTP_CTRL, control & ~(bits.OTPREAD | bits.LDELOAD))  # they clear themselves

    def write_sensor(self) -> None:
        """Follow TC_SARC: its bit 0 has the converter sample (UM 6.4, 7.2.43.1)."""
        memory = self._memory
        ready = memory.get(r.RF_SENSOR_1) == 0x80 and memory.get(r.RF_SENSOR_2) == 0x0F
        if memory.get(r.TC_SARC) & 1 and ready:
            volts, kelvins = self.senses.readings()
            memory.put(r.TC_SARL, volts | kelvins << 8)
