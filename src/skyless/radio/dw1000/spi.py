"""A DW1000 on the pins of a Raspberry Pi or another Linux board: ``/dev/spidev*`` and GPIO lines (extra ``pi``)."""

import asyncio
import contextlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from skyless.core.errors import SkylessError
from skyless.machine import extra_module
from skyless.radio.dw1000.radio import ChipError, Dw1000Radio

START_HZ: Final = 2_000_000
"""Below the 3 MHz that the chip accepts before its PLL is locked."""
DEFAULT_FAST_HZ: Final = 8_000_000
MAX_FAST_HZ: Final = 20_000_000
"""Wires of 10 cm carry about 8 MHz; the chip accepts 20."""
DEFAULT_CHIP: Final = "/dev/gpiochip0"

_NEEDED_FOR: Final = "a DW1000 on SPI"

REOPEN_S: Final = 1.0
CHIP_POLL_S: Final = 0.5e-3
"""Interval for serving a chip without an interrupt line."""
_LINE_CHECK_S: Final = 0.02
"""Interval for serving a chip with an interrupt line, in case an edge was missed."""
MAX_VAIN_INTERRUPTS: Final = 8
"""Consecutive interrupts without an event after which the chip is polled instead."""

_VAIN: Final = (
    "rises though the chip has no event: is irq= the right pin, the wire sound? "
    "The chip is polled every 0.5 ms meanwhile"
)
_MAX_EDGE_READS: Final = 8
"""Each read empties the kernel's queue; a line that rises faster than it is read is not waited for."""


class SpiBus:
    """One chip's SPI device and lines (``skyless.radio.dw1000.radio.Bus``).

    Transfers raise OSError if the kernel refuses them.
    """

    def __init__(
        self,
        bus: int,
        device: int,
        *,
        irq_pin: int | None = None,
        reset_pin: int | None = None,
        gpio_chip: str = DEFAULT_CHIP,
        fast_hz: int = DEFAULT_FAST_HZ,
    ) -> None:
        """Pins are line numbers of ``gpio_chip`` (on a Raspberry Pi the GPIO numbers).

        Raises:
            SkylessError: a package of the extra ``pi`` is missing, a device cannot be opened, or a speed is too high.
        """
        if not START_HZ <= fast_hz <= MAX_FAST_HZ:
            raise SkylessError(f"SPI at {fast_hz} Hz: it should be {START_HZ} to {MAX_FAST_HZ}")
        self._fast_hz = fast_hz
        self._spi: Any = None
        self._irq: Any = None
        self._reset: Any = None
        self._reset_pin = reset_pin
        try:
            self._open_spi(bus, device)
            if irq_pin is not None or reset_pin is not None:
                self._open_lines(gpio_chip, irq_pin)
        except BaseException:
            self.close()
            raise

    def _open_spi(self, bus: int, device: int) -> None:
        spi = extra_module("spidev", _NEEDED_FOR).SpiDev()
        try:
            spi.open(bus, device)
            spi.mode = 0
        except OSError as error:
            raise SkylessError(
                f"/dev/spidev{bus}.{device} cannot be opened ({error.strerror or error}); SPI should be switched on "
                "(Raspberry Pi: dtparam=spi=on in config.txt), and the user in the group spi"
            ) from None
        self._spi = spi
        self.set_spi_fast(False)

    def _open_lines(self, chip: str, irq_pin: int | None) -> None:
        gpiod = extra_module("gpiod", _NEEDED_FOR)
        line = extra_module("gpiod.line", _NEEDED_FOR)
        try:
            if irq_pin is not None:
                raised = gpiod.LineSettings(
                    direction=line.Direction.INPUT, edge_detection=line.Edge.RISING, bias=line.Bias.PULL_DOWN
                )
                self._irq = gpiod.request_lines(chip, {irq_pin: raised}, consumer="skyless irq")
            if self._reset_pin is not None:
                self._floating = gpiod.LineSettings(direction=line.Direction.INPUT, bias=line.Bias.DISABLED)
                self._low = gpiod.LineSettings(direction=line.Direction.OUTPUT, output_value=line.Value.INACTIVE)
                self._reset = gpiod.request_lines(chip, {self._reset_pin: self._floating}, consumer="skyless reset")
        except (OSError, ValueError) as error:
            raise SkylessError(
                f"GPIO lines {irq_pin} (irq) and {self._reset_pin} (reset) of {chip} cannot be used ({error}); they "
                "should be free, and the user in the group gpio"
            ) from None

    def transfer(self, out: bytes) -> bytes:
        """One transaction in both directions."""
        return bytes(self._spi.xfer2(list(out)))

    def set_spi_fast(self, fast: bool) -> None:
        """Use the configured speed, or 2 MHz, from the next transfer on."""
        self._spi.max_speed_hz = self._fast_hz if fast else START_HZ

    def reset_chip(self) -> None:
        """Pull RSTn low for a millisecond, then let it float: the chip pulls it up itself (data sheet 5.6)."""
        if self._reset is not None:
            self._reset.reconfigure_lines({self._reset_pin: self._low})
            time.sleep(0.001)
            self._reset.reconfigure_lines({self._reset_pin: self._floating})

    def pause_us(self, microseconds: int) -> None:
        """Sleep."""
        time.sleep(microseconds * 1e-6)

    def fileno(self) -> int | None:
        """File descriptor that becomes readable when the interrupt line rises; None without a line."""
        return None if self._irq is None else self._irq.fd

    def is_raised(self) -> bool:
        """Whether the interrupt line is high; always True without one, so that the chip is polled."""
        return self._irq is None or bool(self._irq.get_value(self._irq.offsets[0]).value)

    def forget_edges(self) -> None:
        """Make ``fileno`` unreadable until the line rises again; check ``is_raised`` afterwards."""
        for _ in range(_MAX_EDGE_READS):
            if self._irq is None or not self._irq.wait_edge_events(0):
                return
            self._irq.read_edge_events()

    def close(self) -> None:
        """Release device and lines."""
        for line in (self._irq, self._reset):
            if line is not None:
                line.release()
        self._irq = self._reset = None
        if self._spi is not None:
            self._spi.close()
            self._spi = None


class SpiPort:
    """A chip on SPI (``skyless.radio.dw1000.radio.Port``)."""

    def __init__(self, name: str, open_bus: Callable[[], SpiBus]) -> None:
        """``open_bus`` is called again after each failure."""
        self._name, self._open_bus = name, open_bus

    async def run(self, radio: Dw1000Radio) -> None:
        """Serve the chip until cancelled, and search for it again when it does not answer."""
        while True:
            try:
                bus = self._open_bus()
            except SkylessError as error:
                radio.end(str(error))
            else:
                try:
                    await self._serve(bus, radio)
                except (OSError, ChipError) as error:
                    radio.end(f"{self._name}: {error}")
                finally:
                    bus.close()
            await asyncio.sleep(REOPEN_S)

    async def _serve(self, bus: SpiBus, radio: Dw1000Radio) -> None:
        """Serve the chip when its interrupt line rises; without a line at short intervals."""
        radio.begin(bus)
        loop, line = asyncio.get_running_loop(), bus.fileno()
        if line is None:
            while True:
                await asyncio.sleep(CHIP_POLL_S)
                radio.serve()
        risen = asyncio.Event()
        loop.add_reader(line, risen.set)
        try:
            await self._serve_line(bus, radio, risen)
        finally:
            loop.remove_reader(line)

    async def _serve_line(self, bus: SpiBus, radio: Dw1000Radio, risen: asyncio.Event) -> None:
        """Serve the chip while its line is high after a rise; a line without events is polled instead."""
        vain = 0
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_LINE_CHECK_S):
                    await risen.wait()
            is_high = risen.is_set()
            bus.forget_edges()
            risen.clear()
            while True:
                vain = 0 if radio.serve() or not is_high else vain + 1
                if vain == MAX_VAIN_INTERRUPTS:
                    radio.report_fault("irq-in-vain", f"the interrupt line of {self._name} {_VAIN}")
                if vain >= MAX_VAIN_INTERRUPTS:
                    await asyncio.sleep(CHIP_POLL_S)
                is_high = bus.is_raised()
                if not is_high:
                    break
                await asyncio.sleep(0)


def check_spi(spec: str, bus: int, device: int, gpio_chip: str | None) -> None:
    """Check that packages and device files exist and are accessible; later failures may be temporary.

    ``gpio_chip`` is None if no lines are used.

    Raises:
        SkylessError: naming what a person has to change.
    """
    try:
        for package in ("spidev",) if gpio_chip is None else ("spidev", "gpiod", "gpiod.line"):
            extra_module(package, _NEEDED_FOR)
    except SkylessError as error:
        raise SkylessError(f"--radio is {spec!r}; {error}") from None
    remedy = "SPI should be switched on (Raspberry Pi: dtparam=spi=on in config.txt), spi:BUS.DEVICE name one"
    _check_file(spec, f"/dev/spidev{bus}.{device}", "spi", remedy)
    if gpio_chip is not None:
        _check_file(spec, gpio_chip, "gpio", "chip= should name the GPIO chip of irq and reset")


def _check_file(spec: str, path: str, group: str, remedy: str) -> None:
    if not os.path.exists(path):  # noqa: PTH110 - Path.exists raises where the folder may not be read
        kind = path.rstrip("0123456789.")
        there = ", ".join(map(str, sorted(Path(kind).parent.glob(f"{Path(kind).name}*")))) or "none"
        raise SkylessError(f"--radio is {spec!r}; there is no {path} (here: {there}); {remedy}")
    if not os.access(path, os.R_OK | os.W_OK):
        raise SkylessError(
            f"--radio is {spec!r}; {path} may not be opened: its group, usually {group}, must be one of yours "
            "(sudo usermod -aG ...)"
        )
