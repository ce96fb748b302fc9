"""Peripherals of the nRF52832 without those that move data: registers as in its product specification (v1.4).

Each has its tasks, events and registers by offset; whatever the firmware uses besides is an ``EmulationError``.
Not modelled: start-up times except those of the clocks, power consumption, flash writes outside the last page, pins as
the processor's analogue or debug functions, and timers' events in counter mode.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Final, Protocol

from emulator.processor.cortex_m4 import EmulationError

HFCLK_START_CYCLES: Final = 64 * 360
LFCLK_START_CYCLES: Final = 64 * 250_000
"""Start-up times of the fast and of the slow crystal, as the specification gives them."""

ERASE_CYCLES: Final = 64 * 85_000
WRITE_CYCLES: Final = 64 * 41
"""For which the processor stands still, of a page and of a word; the specification's longest."""

RESET_BY_PIN: Final = 1 << 0
RESET_WATCHDOG: Final = 1 << 1
RESET_SOFTWARE: Final = 1 << 2
RESET_LOCKUP: Final = 1 << 3
"""Bits of RESETREAS."""

KEEP_RAM: Final = 0x45
"""What the factory has left for anomaly 108 of this processor, in the bits that count."""

_WATCHDOG_KEY: Final = 0x6E524635
_NEVER: Final = 1 << 62
_INTEN: Final = 0x300
_GPIO_CONFIG: Final = range(0x700, 0x780, 4)


class System(Protocol):
    """What a peripheral knows of its processor."""

    misuse: Counter[str]

    @property
    def cycles(self) -> int:
        """The present, in cycles of 64 MHz since power-on."""

    def run_task(self, address: int) -> None:
        """Start a task by its address, as PPI does."""

    def run_channels(self, address: int) -> None:
        """Start what PPI connects to the event at this address."""

    def update_interrupt(self, peripheral: "Peripheral") -> None:
        """A peripheral's line may have changed."""

    def load(self, address: int, size: int) -> bytes:
        """Read RAM."""

    def store(self, address: int, data: bytes) -> None:
        """Write RAM."""

    def plan(self, cycles: int, happen: Callable[[], object]) -> None:
        """Let something happen at a count of cycles, unless the processor is reset before."""

    def has_input_buffer(self, pin: int) -> bool:
        """Whether the processor sees a pin's level."""


class Peripheral:
    """Tasks, events, interrupts by INTEN, and registers that keep what is written."""

    base = 0
    irq: int | None = None

    def __init__(
        self,
        system: System,
        *,
        tasks: Mapping[int, Callable[[], None]] | None = None,
        events: Iterable[int] = (),
        registers: Iterable[int] = (),
        triples: tuple[int, ...] = (),
    ) -> None:
        """All by offset. ``triples``: registers with one behind them that sets bits, and another that clears them."""
        self.system, self.tasks = system, dict(tasks or {})
        self.event_bits = {offset: 1 << ((offset - 0x100) >> 2) for offset in events}
        """Of each event its bit in INTEN."""
        self.events = 0
        """Bits of the events that have happened and were not cleared."""
        triples += (_INTEN,) if self.event_bits else ()
        self.registers = dict.fromkeys((*registers, *triples), 0)
        self._first_of = {first + behind: first for first in triples for behind in (0, 4, 8)}

    def read(self, offset: int) -> int:
        """A load."""
        if offset in self.event_bits:
            return int(self.events & self.event_bits[offset] != 0)
        offset = self._first_of.get(offset, offset)
        if offset not in self.registers:
            raise self.unknown(offset)
        return self.registers[offset]

    def write(self, offset: int, value: int) -> None:
        """A store."""
        if offset in self.tasks:
            if value == 1:
                self.tasks[offset]()
        elif offset in self.event_bits:
            bit = self.event_bits[offset]
            self.events = self.events | bit if value else self.events & ~bit
            self.system.update_interrupt(self)
        elif offset in self._first_of:
            first = self._first_of[offset]
            held = self.registers[first]
            self.registers[first] = (value, held | value, held & ~value)[(offset - first) >> 2]
            self.system.update_interrupt(self)
        elif offset in self.registers:
            self.registers[offset] = value
        else:
            raise self.unknown(offset)

    def unknown(self, offset: int) -> EmulationError:
        """The error for a register that is not modelled."""
        return EmulationError(f"{type(self).__name__} has no register 0x{offset:03x} (0x{self.base + offset:08x})")

    def happen(self, offset: int) -> None:
        """An event: it runs PPI's tasks, and may ask for an interrupt."""
        self.events |= self.event_bits[offset]
        self.system.run_channels(self.base + offset)
        self.system.update_interrupt(self)

    @property
    def line(self) -> bool:
        """Whether the peripheral asks for an interrupt."""
        return bool(self.events & self.registers.get(_INTEN, 0))


class Constants(Peripheral):
    """Words that nothing changes."""

    def __init__(self, system: System, base: int, values: dict[int, int]) -> None:
        super().__init__(system)
        self.base, self.registers = base, values

    def write(self, offset: int, value: int) -> None:  # noqa: ARG002
        """A store, which hardware has not."""
        raise self.unknown(offset)


def factory_information(system: System, identity: bytes) -> Constants:
    """FICR: the device's identifier and Bluetooth address, low words first; part; what anomaly 108 needs."""
    words = {0x060 + 4 * n: int.from_bytes(identity[4 * n : 4 * n + 4], "little") for n in range(2)}
    words |= {0x0A4: 0x89ABCDEF, 0x0A8: 0xFFFF0123, 0x100: 0x52832, 0x104: 0x41414530, 0x258: 0xFFFFFF00 | KEEP_RAM}
    return Constants(system, 0x10000000, words)


REVISION_3: Final = 7


def identification(system: System, revision: int) -> Constants:
    """Identification of an nRF52832; its revisions 1 to 3 are 5 to 7 there."""
    return Constants(system, 0xF0000000, {0xFE0: 0x06, 0xFE4: 0x00, 0xFE8: revision << 4})


class Clock(Peripheral):
    """CLOCK and POWER; with CONSTLAT the latency stays the one assumed."""

    base = 0x40000000
    irq = 0

    def __init__(self, system: System, cause: int, revision: int) -> None:
        super().__init__(
            system,
            tasks={
                0x000: self._start_hfclk,
                0x004: self._stop_hfclk,
                0x008: self._start_lfclk,
                0x00C: self._stop_lfclk,
                0x078: lambda: None,
            },
            events=(0x100, 0x104),
            # RESETREAS, LFCLKSRC, DCDCEN, the one of anomaly 108, and APPROTECT.DISABLE
            registers=(0x400, 0x518, 0x578, 0xEE4, *((0x558,) if revision >= REVISION_3 else ())),
        )
        self.registers[0x400] = cause
        self.is_slow_started = False
        self._ready = {0x100: _NEVER, 0x104: _NEVER}
        self.crystal_cycles = _NEVER
        """When the fast crystal is stable."""

    def _start_hfclk(self) -> None:
        self._ready[0x100] = self.crystal_cycles = self.system.cycles + HFCLK_START_CYCLES

    def _start_lfclk(self) -> None:
        self.is_slow_started = True
        self._ready[0x104] = self.system.cycles + LFCLK_START_CYCLES

    def _stop_hfclk(self) -> None:
        self._ready[0x100] = self.crystal_cycles = _NEVER

    def _stop_lfclk(self) -> None:
        self._ready[0x104] = _NEVER

    def read(self, offset: int) -> int:
        """A load; clocks that have started meanwhile are shown."""
        for event, ready in self._ready.items():
            if ready <= self.system.cycles:
                self._ready[event] = _NEVER
                self.events |= self.event_bits[event]
        return super().read(offset)

    def write(self, offset: int, value: int) -> None:
        """A store; ones clear RESETREAS."""
        if offset in self._first_of and value:
            raise self.unknown(offset)
        super().write(offset, self.registers[0x400] & ~value if offset == 0x400 else value)


class Timer(Peripheral):
    """TIMER0 to TIMER2; comparisons in timer mode only, and no SHORTS."""

    _widths = (16, 8, 24, 32)

    def __init__(self, system: System, number: int) -> None:
        self.base, self.irq = 0x40008000 + 0x1000 * number, 8 + number
        tasks = {0x000: self._start, 0x004: self._stop, 0x008: self._count, 0x00C: self._clear, 0x010: self._shut_down}
        super().__init__(
            system,
            tasks=tasks | {0x040 + 4 * n: partial(self._capture, n) for n in range(4)},
            events=range(0x140, 0x150, 4),  # COMPARE
            registers=(0x504, 0x508, 0x510, *range(0x540, 0x550, 4)),  # MODE, BITMODE, PRESCALER, CC
        )
        self.registers[0x510] = 4
        self._step_cycles, self._mask, self._counts_events = 64, 0xFFFF, False
        self.draws_current = False
        self._counted = 0
        """Count when the timer was started or stopped last, or of events."""
        self._started_cycles: int | None = None
        self._next_match = [_NEVER] * 4

    def _elapsed(self) -> int:
        """Counts since the start."""
        return (self.system.cycles - (self._started_cycles or 0)) // self._step_cycles

    def _value(self) -> int:
        if self._started_cycles is None or self._counts_events:
            return self._counted & self._mask
        return (self._counted + self._elapsed()) & self._mask

    def _start(self) -> None:
        self.draws_current = True
        if self._started_cycles is None:
            self._started_cycles = self.system.cycles
        self._foresee_all()

    def _stop(self) -> None:
        self._counted, self._started_cycles = self._value(), None
        self._foresee_all()

    def _count(self) -> None:
        if self._counts_events and self._started_cycles is not None:
            self._counted += 1

    def _clear(self) -> None:
        self._counted = 0
        if self._started_cycles is not None:
            self._started_cycles = self.system.cycles
        self._foresee_all()

    def _shut_down(self) -> None:
        """Stop, at 0, and draw no current any more (anomaly 78)."""
        self._counted, self._started_cycles, self.draws_current = 0, None, False
        self._foresee_all()

    def _capture(self, n: int) -> None:
        self.registers[0x540 + 4 * n] = self._value()
        self._foresee(n)  # it is equal now, and again a whole turn later

    def write(self, offset: int, value: int) -> None:
        """A store."""
        super().write(offset, value)
        if offset >= 0x540:
            self._foresee((offset - 0x540) >> 2)
        elif offset >= 0x504:
            self._step_cycles = 4 << self.registers[0x510]
            self._mask = (1 << self._widths[self.registers[0x508] & 3]) - 1
            self._counts_events = self.registers[0x504] != 0
            self._foresee_all()

    def _foresee_all(self) -> None:
        for n in range(4):
            self._foresee(n)

    def _foresee(self, n: int) -> None:
        """When the count will next become equal to a CC; one that is equal already has to wait for a whole turn."""
        if self._started_cycles is None or self._counts_events:
            self._next_match[n] = _NEVER
            return
        elapsed = self._elapsed()
        ahead = (self.registers[0x540 + 4 * n] - self._counted - elapsed) & self._mask or self._mask + 1
        self._next_match[n] = self._started_cycles + (elapsed + ahead) * self._step_cycles

    def update(self) -> None:
        """Raise the events of counts that have been reached."""
        now = self.system.cycles
        for n in range(4):
            if self._next_match[n] <= now:
                self._next_match[n] += (self._mask + 1) * self._step_cycles
                self.happen(0x140 + 4 * n)

    @property
    def due_cycles(self) -> int:
        """When the next interrupt will be asked for."""
        inten = self.registers[_INTEN]
        return min((at for n, at in enumerate(self._next_match) if inten >> (16 + n) & 1), default=_NEVER)

    def read(self, offset: int) -> int:
        """A load."""
        if offset in self.event_bits:
            self.update()
        return super().read(offset)


class Rtc(Peripheral):
    """RTC1 without a prescaler, on an ideal slow clock: one comparison; it counts from 0 whenever it is started."""

    base = 0x40011000
    irq = 17
    _MASK = 0xFFFFFF

    def __init__(self, system: System) -> None:
        tasks = {0x000: self._start, 0x004: self._stop, 0x008: lambda: None}  # CLEAR of one that is stopped
        super().__init__(system, tasks=tasks, events=(0x140,), registers=(0x540,))  # COMPARE0, CC0
        self._zero: int | None = None
        """Period of 1/32768 s at which the count was 0."""
        self.due_cycles = _NEVER

    def _start(self) -> None:
        self._zero = self._periods()

    def _stop(self) -> None:
        self._zero, self.due_cycles = None, _NEVER

    def _periods(self) -> int:
        return self.system.cycles * 32_768 // 64_000_000

    def read(self, offset: int) -> int:
        """A load; COUNTER."""
        if offset != 0x504:
            return super().read(offset)
        return 0 if self._zero is None else self._periods() - self._zero & self._MASK

    def write(self, offset: int, value: int) -> None:
        """A store; a comparison less than two periods ahead may be missed, so it is."""
        super().write(offset, value)
        if offset == 0x540 and self._zero is not None:
            ahead = (value - self.read(0x504) - 2 & self._MASK) + 2
            self.due_cycles = -(-(self._periods() + ahead) * 64_000_000 // 32_768)

    def update(self) -> None:
        """Raise the event of a count that has been reached."""
        if self.due_cycles <= self.system.cycles:
            self.due_cycles = _NEVER
            self.happen(0x140)


class Gpio(Peripheral):
    """Pins of port 0; one whose input buffer is off reads 0.

    ``level`` gives what is on an input from outside, by pin and pull; ``on_output`` is called at every change.
    """

    base = 0x50000000
    _OUT, _IN, _DIR = 0x504, 0x510, 0x514

    def __init__(self, system: System, level: Callable[[int, int], bool], on_output: Callable[[], None]) -> None:
        super().__init__(system, registers=_GPIO_CONFIG, triples=(self._OUT, self._DIR))
        self.registers |= dict.fromkeys(_GPIO_CONFIG, 2)
        self._inputs: list[int] = []
        """Pins whose input buffer is on."""
        self._level, self._on_output = level, on_output

    def is_driven(self, pin: int, high: bool) -> bool:
        """Whether the processor holds a pin at a level."""
        return bool(self.registers[self._DIR] >> pin & 1) and bool(self.registers[self._OUT] >> pin & 1) == high

    def has_input_buffer(self, pin: int) -> bool:
        """Whether the processor sees a pin's level."""
        return not self.registers[_GPIO_CONFIG[pin]] & 2

    def read(self, offset: int) -> int:
        """A load."""
        if offset == self._IN:
            return sum(self._input(pin) << pin for pin in self._inputs)
        value = super().read(offset)
        if offset in _GPIO_CONFIG:
            return value & ~1 | self.registers[self._DIR] >> _GPIO_CONFIG.index(offset) & 1
        return value

    def _input(self, pin: int) -> int:
        """A pin that the processor drives reads as driven."""
        if self.registers[self._DIR] >> pin & 1:
            return self.registers[self._OUT] >> pin & 1
        return int(self._level(pin, self.registers[_GPIO_CONFIG[pin]] >> 2 & 3))

    def write(self, offset: int, value: int) -> None:
        """A store."""
        super().write(offset, value)
        if offset in _GPIO_CONFIG:
            pin = _GPIO_CONFIG.index(offset)
            self._inputs = [pin for pin in range(32) if self.has_input_buffer(pin)]
            self.registers[self._DIR] = self.registers[self._DIR] & ~(1 << pin) | (value & 1) << pin
        self._on_output()


class Gpiote(Peripheral):
    """Events of pins: all channels, in event mode."""

    base = 0x40006000
    irq = 6
    CONFIG = range(0x510, 0x530, 4)

    def __init__(self, system: System) -> None:
        super().__init__(system, events=(*range(0x100, 0x120, 4), 0x17C), registers=self.CONFIG)  # IN, PORT

    def on_edge(self, pin: int, high: bool) -> None:
        """A pin has changed; polarity 1 is rising, 2 falling, 3 both."""
        for n in range(8):
            config = self.registers[self.CONFIG[n]]
            if config & 3 == 1 and config >> 8 & 31 == pin and config >> 16 & 3 & (1 if high else 2):
                self.happen(0x100 + 4 * n)


class Watchdog(Peripheral):
    """WDT; once started it runs through soft resets."""

    base = 0x40010000
    irq = 16

    def __init__(self, system: System, has_clock: Callable[[], bool]) -> None:
        """``has_clock``: whether the slow clock was started; the watchdog would choose its source otherwise."""
        registers = (0x504, 0x508, 0x50C)  # CRV, RREN, CONFIG
        super().__init__(system, tasks={0x000: self._start}, events=(0x100,), registers=registers)  # TIMEOUT
        self.registers |= {0x504: 0xFFFFFFFF, 0x508: 1, 0x50C: 1}
        self.due_cycles = _NEVER
        self._fed = 0
        self._has_clock = has_clock

    @property
    def is_running(self) -> bool:
        """Whether it has been started."""
        return self.due_cycles < _NEVER

    def _restart(self) -> None:
        self._fed = 0
        self.due_cycles = self.system.cycles + (self.registers[0x504] + 1) * 64_000_000 // 32_768

    def _start(self) -> None:
        """Its settings are fixed from now on."""
        if not self._has_clock():
            self.system.misuse["watchdog-before-slow-clock"] += 1
        if not self.is_running:
            self._restart()

    def read(self, offset: int) -> int:
        """A load."""
        if offset == 0x400:
            return int(self.is_running)
        if offset == 0x404:
            return self.registers[0x508] & ~self._fed
        return super().read(offset)

    def write(self, offset: int, value: int) -> None:
        """A store."""
        if 0x600 <= offset < 0x620:
            if value == _WATCHDOG_KEY and self.is_running:
                self._fed |= 1 << ((offset - 0x600) >> 2)
                if self._fed & self.registers[0x508] == self.registers[0x508]:
                    self._restart()
            return
        if offset in {0x504, 0x508, 0x50C} and self.is_running:
            return
        super().write(offset, value)
        if offset == 0x50C and not value & 1:
            raise EmulationError("the watchdog is to stop while the processor sleeps, which is not modelled")


class Ppi(Peripheral):
    """Programmable channels from events to tasks."""

    base = 0x4001F000
    _CHEN = 0x500

    def __init__(self, system: System) -> None:
        super().__init__(system, registers=range(0x510, 0x5B0, 4), triples=(self._CHEN,))  # EEP and TEP

    def on_event(self, address: int) -> None:
        """Start the tasks of an event's channels."""
        enabled, n = self.registers[self._CHEN], 0
        while enabled:
            if enabled & 1 and self.registers[0x510 + 8 * n] == address:
                self.system.run_task(self.registers[0x514 + 8 * n])
            enabled >>= 1
            n += 1


class Nvmc(Peripheral):
    """The flash's controller: the cache, and erasing the page of settings."""

    base = 0x4001E000

    def __init__(
        self, system: System, use_cache: Callable[[bool], None], page: "FlashPage", configuration: "FlashPage"
    ) -> None:
        super().__init__(system, registers=(0x400, 0x504, 0x540))  # READY, CONFIG, ICACHECNF
        self.registers[0x400] = 1
        self._use_cache, self._page, self._configuration = use_cache, page, configuration

    def write(self, offset: int, value: int) -> None:
        """A store; ERASEPAGE."""
        if offset == 0x508:
            self._page.erase(value, enabled=self.registers[0x504] == 2)
        elif offset == 0x400:
            raise self.unknown(offset)
        else:
            super().write(offset, value)
            self._page.is_writable = self._configuration.is_writable = self.registers[0x504] == 1
        if offset == 0x540:
            self._use_cache(bool(value & 1))


class FlashPage(Peripheral):
    """A page of the flash, which outlives resets: the last one, for settings, or UICR. Writing clears bits."""

    base = 0x7F000

    def __init__(self, system: System, wait: Callable[[int], None], base: int = base) -> None:
        super().__init__(system)
        self.base, self.is_writable = base, False
        self._wait = wait
        self.registers = dict.fromkeys(range(0, 0x1000, 4), 0xFFFFFFFF)

    def hold(self, data: bytes, first: int = 0) -> None:
        """Contents from before the start."""
        words = (data[at : at + 4].ljust(4, b"\0") for at in range(0, len(data), 4))
        self.registers |= {first + 4 * at: int.from_bytes(word, "little") for at, word in enumerate(words)}

    def erase(self, address: int, *, enabled: bool) -> None:
        """Set all bits."""
        if address != self.base or not enabled:
            raise EmulationError(f"the page at 0x{address:08x} is erased, which is not the settings', or not enabled")
        self._wait(ERASE_CYCLES)
        self.registers = dict.fromkeys(self.registers, 0xFFFFFFFF)

    def write(self, offset: int, value: int) -> None:
        """A store."""
        if not self.is_writable:
            raise EmulationError(f"flash is written at 0x{self.base + offset:08x}, which NVMC does not allow now")
        self._wait(WRITE_CYCLES)
        self.registers[offset] &= value


class Nvic(Peripheral):
    """Interrupt controller and System Control Block; its ``irq`` lines are levels."""

    base = 0xE000E000
    _ISER, _ICER, _ISPR, _ICPR = 0x100, 0x180, 0x200, 0x280

    def __init__(
        self,
        system: System,
        fault_status: Callable[[], tuple[int, int, int]],
        reset: Callable[[], None],
        use_fpu: Callable[[bool], None],
    ) -> None:
        # Kept, without effect: priorities of interrupts and exceptions, VTOR, SCR, CCR, SHCSR, FPCCR; and CPACR.
        kept = (*range(0x400, 0x428, 4), 0xD08, *range(0xD10, 0xD28, 4), 0xD88, 0xF34)
        super().__init__(system, registers=kept)
        self.enabled = self.pending = self.asserted = 0
        self._fault_status, self._reset, self._use_fpu = fault_status, reset, use_fpu

    @property
    def wakes(self) -> bool:
        """Whether an interrupt is pending that ends WFI."""
        return bool(self.pending & self.enabled)

    def set_line(self, irq: int, asserted: bool) -> None:
        """A peripheral's line is high or low now."""
        if asserted:
            self.asserted |= 1 << irq
            self.pending |= 1 << irq
        else:
            self.asserted &= ~(1 << irq)

    def read(self, offset: int) -> int:
        """A load."""
        hfsr, cfsr, bfar = self._fault_status()
        values = {0xD28: cfsr, 0xD2C: hfsr, 0xD38: bfar, 0xD34: 0, 0xD0C: 0xFA050000, 0xD00: 0x410FC241, 0xD04: 0}
        for first, bits in {self._ISER: self.enabled, self._ISPR: self.pending}.items():
            values |= dict.fromkeys((first, first + 0x80), bits & 0xFFFFFFFF)
            values |= dict.fromkeys((first + 4, first + 0x84), bits >> 32)
        return values[offset] if offset in values else super().read(offset)

    def write(self, offset: int, value: int) -> None:
        """A store."""
        bits, first = value << (32 if offset & 4 else 0), offset & ~4
        if first == self._ISER:
            self.enabled |= bits
        elif first == self._ICER:
            self.enabled &= ~bits
        elif first == self._ISPR:
            self.pending |= bits
        elif first == self._ICPR:
            self.pending = self.pending & ~bits | self.asserted
        elif offset == 0xD0C:
            if value >> 16 == 0x05FA and value & 4:
                self._reset()
        elif offset == 0xD88:
            super().write(offset, value)
            self._use_fpu(value >> 20 & 0xF == 0xF)
        elif offset not in {0xD28, 0xD2C}:  # flags that ones clear; nothing reads them again
            super().write(offset, value)
