"""Clocks, reset, microcode, one-time memory and sensors of the chip, from the DW1000 User Manual v2.12."""

from collections import Counter
from collections.abc import Callable
from typing import Final

from msgspec import Struct

from skyless.simulation.dw1000 import registers as r
from skyless.simulation.dw1000.memory import Memory

_LOCK_S: Final = 15e-6
"""Until the PLL has locked after a reset; the manual states no guaranteed figure, drivers wait for CPLOCK."""
_LOAD_S: Final = 150e-6
"""Until the microcode is loaded (UM 2.5.5.10: table 4)."""
_MAX_CRYSTAL_HZ: Final = 3_000_000
"""Fastest SPI while the chip runs on the crystal (UM 2.3.2: INIT)."""
_MAX_PLL_HZ: Final = 20_000_000

_TEMPERATURE_STEP_C: Final = 1.14
_REFERENCE_C: Final = 23.0
_STEPS_PER_V: Final = 173.0
_REFERENCE_V: Final = 3.3
"""UM pp. 158-159; the readings at these references are in the OTP."""


class Sensors(Struct, frozen=True):
    """Temperature and supply of a chip, and its factory calibration."""

    temperature_c: float = 31.0
    supply_v: float = 3.3
    reading_at_23_c: int = 0x7E
    reading_at_3_3_v: int = 0x6C
    crystal_trim: int = 0x11
    part: int = 0x10205EAD

    def readings(self) -> tuple[int, int]:
        """SAR_LVBAT and SAR_LTEMP (UM 7.2.43.2)."""
        volts = round((self.supply_v - _REFERENCE_V) * _STEPS_PER_V) + self.reading_at_3_3_v
        kelvins = round((self.temperature_c - _REFERENCE_C) / _TEMPERATURE_STEP_C) + self.reading_at_23_c
        return min(max(volts, 0), 255), min(max(kelvins, 0), 255)

    def otp(self) -> dict[int, int]:
        """Words of the one-time programmable memory that are not 0 (UM 6.3.1)."""
        return {
            0x006: self.part,
            0x007: 0x4C4F5431,
            0x008: self.reading_at_3_3_v | 0xB0 << 8,
            0x009: self.reading_at_23_c | 0x8E << 8,
            0x01E: self.crystal_trim,
        }


class Clocking:
    """What must have happened before the chip can send or receive. ``seconds`` is any clock that runs on."""

    def __init__(self, memory: Memory, misuse: Counter[str], seconds: Callable[[], float], sensors: Sensors) -> None:
        self._memory, self._misuse, self._seconds, self._sensors = memory, misuse, seconds, sensors
        self._lock_s = seconds() + _LOCK_S
        self._loaded_s: float | None = None
        self.in_reset = False

    def restart(self) -> None:
        """As after power-on or a reset: nothing is loaded, the PLL begins to lock."""
        self._loaded_s = None
        self._lock_s = self._seconds() + _LOCK_S

    @property
    def locked(self) -> bool:
        """Whether the chip runs on its PLL."""
        forced = self._memory.get(r.PMSC_CTRL0) & r.SYSCLKS == r.SYSCLKS_XTI
        return not forced and self.pll_has_locked

    @property
    def pll_has_locked(self) -> bool:
        """CPLOCK: the PLL may have locked while the crystal is still forced."""
        return not self.in_reset and self._seconds() >= self._lock_s

    @property
    def microcode_loaded(self) -> bool:
        """Whether the leading edge is searched for."""
        return self._loaded_s is not None and self._seconds() >= self._loaded_s

    def accepts(self, hz: int) -> bool:
        """Whether a transfer at that rate arrives unspoilt."""
        return hz <= (_MAX_PLL_HZ if self.locked else _MAX_CRYSTAL_HZ)

    def on_pmsc_written(self) -> int | None:
        """Apply PMSC_CTRL0; returns SOFTRESET where it resets something."""
        kind = self._memory.get(r.PMSC_CTRL0) >> r.SOFTRESET_SHIFT
        if kind == r.SOFTRESET_ALL and not self.in_reset:
            if self._memory.get(r.PMSC_CTRL0) & r.SYSCLKS != r.SYSCLKS_XTI:
                self._misuse["reset-not-on-crystal"] += 1  # UM 7.2.50.1
            self.in_reset = True
            return kind
        if kind == r.SOFTRESET_NONE and self.in_reset:
            self.in_reset = False
            self.restart()
        return kind if kind == r.SOFTRESET_RX else None

    def on_otp_written(self) -> None:
        """Apply OTP_CTRL: read a word, or load the microcode (UM 6.3.2, 2.5.5.10)."""
        control = self._memory.get(r.OTP_CTRL)
        if control & r.OTPREAD:
            address = self._memory.get(r.OTP_ADDR) & 0x7FF
            self._memory.set(r.OTP_RDAT, self._sensors.otp().get(address, 0))
        if control & r.LDELOAD:
            if self._memory.get(r.PMSC_CTRL0) & 0xFFFF == r.PMSC_FOR_LDE:
                self._loaded_s = self._seconds() + _LOAD_S
            else:
                self._misuse["microcode-without-its-clock"] += 1
        self._memory.set(r.OTP_CTRL, control & ~(r.OTPREAD | r.LDELOAD))  # they clear themselves

    def on_sensor_written(self) -> None:
        """Apply TC_SARC: its bit 0 lets the converter sample (UM 6.4, 7.2.43.1)."""
        memory = self._memory
        ready = memory.get(r.RF_SENSOR_1) == 0x80 and memory.get(r.RF_SENSOR_2) == 0x0F
        if memory.get(r.TC_SARC) & 1 and ready:
            volts, kelvins = self._sensors.readings()
            memory.set(r.TC_SARL, volts | kelvins << 8)
