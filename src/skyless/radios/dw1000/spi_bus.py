"""A DW1000 on the pins of a Raspberry Pi or another Linux board: ``/dev/spidev*`` and GPIO lines (extra ``pi``)."""

import importlib
import os
import time
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from skyless.errors import SkylessError
from skyless.firmware.dw1000 import Bus

SLOW_HZ: Final = 2_000_000
"""Below the 3 MHz that the chip takes before its PLL has lock."""
DEFAULT_FAST_HZ: Final = 8_000_000
MAX_FAST_HZ: Final = 20_000_000
"""Wires of a hand's length carry some 8 MHz; the chip takes 20."""
RESET_S: Final = 0.001
MOST_EDGE_READS: Final = 8
"""Each takes all that the kernel keeps; a line that rises faster than it is read is not waited for."""
DEFAULT_CHIP: Final = "/dev/gpiochip0"


class SpiBus(Bus):
    """One chip's SPI device and lines; transfers raise OSError where the kernel refuses them."""

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
        if not SLOW_HZ <= fast_hz <= MAX_FAST_HZ:
            raise SkylessError(f"SPI at {fast_hz} Hz: it should be {SLOW_HZ} to {MAX_FAST_HZ}")
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
        spi = _package("spidev").SpiDev()
        try:
            spi.open(bus, device)
            spi.mode = 0
        except OSError as error:
            raise SkylessError(
                f"/dev/spidev{bus}.{device} cannot be opened ({error.strerror or error}); SPI should be switched on "
                "(Raspberry Pi: dtparam=spi=on in config.txt), and the user in the group spi"
            ) from None
        self._spi = spi
        self.slow()

    def _open_lines(self, chip: str, irq_pin: int | None) -> None:
        gpiod = _package("gpiod")
        line = _package("gpiod.line")
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
                f"GPIO lines {irq_pin} (irq) and {self._reset_pin} (reset) of {chip} cannot be had ({error}); they "
                "should be free, and the user in the group gpio"
            ) from None

    def transfer(self, out: memoryview, into: memoryview) -> None:
        """One transaction in both directions."""
        into[:] = bytes(self._spi.xfer2(list(out)))

    def write(self, header: memoryview, data: memoryview) -> None:
        """One transaction that only sends."""
        self._spi.xfer2([*header, *data])

    def slow(self) -> None:
        """2 MHz from now on."""
        self._spi.max_speed_hz = SLOW_HZ

    def fast(self) -> None:
        """The configured speed from now on."""
        self._spi.max_speed_hz = self._fast_hz

    def reset(self) -> bool:
        """Pull RSTn low for a millisecond, then let it float: the chip pulls it up itself (data sheet 5.6)."""
        if self._reset is None:
            return False
        self._reset.reconfigure_lines({self._reset_pin: self._low})
        time.sleep(RESET_S)
        self._reset.reconfigure_lines({self._reset_pin: self._floating})
        return True

    def pause_us(self, microseconds: int) -> None:
        """Sleep."""
        time.sleep(microseconds * 1e-6)

    def fileno(self) -> int | None:
        """What becomes readable when the interrupt line rises; None without one."""
        return None if self._irq is None else self._irq.fd

    def is_raised(self) -> bool:
        """Whether the interrupt line is high; without one always, so that the chip is asked."""
        return self._irq is None or bool(self._irq.get_value(self._irq.offsets[0]).value)

    def forget_edges(self) -> None:
        """Make ``fileno`` unreadable until the line rises again; look at ``is_raised`` after it."""
        for _ in range(MOST_EDGE_READS):
            if self._irq is None or not self._irq.wait_edge_events(0):
                return
            self._irq.read_edge_events()

    def close(self) -> None:
        """Let go of device and lines."""
        for line in (self._irq, self._reset):
            if line is not None:
                line.release()
        self._irq = self._reset = None
        if self._spi is not None:
            self._spi.close()
            self._spi = None


def check_place(spec: str, bus: int, device: int, gpio_chip: str | None) -> None:
    """See that packages and device files are there and may be used; what fails later may pass by itself.

    ``gpio_chip`` is None where no lines are wanted.

    Raises:
        SkylessError: nothing will come of this until somebody mends it; naming what.
    """
    try:
        for package in ("spidev",) if gpio_chip is None else ("spidev", "gpiod", "gpiod.line"):
            _package(package)
    except SkylessError as error:
        raise SkylessError(f"--radio is {spec!r}; {error}") from None
    mend = "SPI should be switched on (Raspberry Pi: dtparam=spi=on in config.txt), spi:BUS.DEVICE name one"
    _check_file(spec, f"/dev/spidev{bus}.{device}", "spi", mend)
    if gpio_chip is not None:
        _check_file(spec, gpio_chip, "gpio", "chip= should name the GPIO chip of irq and reset")


def _check_file(spec: str, path: str, group: str, mend: str) -> None:
    if not os.path.exists(path):  # noqa: PTH110 - Path.exists raises where nobody may look
        kind = path.rstrip("0123456789.")
        there = ", ".join(map(str, sorted(Path(kind).parent.glob(f"{Path(kind).name}*")))) or "none"
        raise SkylessError(f"--radio is {spec!r}; there is no {path} (here: {there}); {mend}")
    if not os.access(path, os.R_OK | os.W_OK):
        raise SkylessError(
            f"--radio is {spec!r}; {path} may not be opened: its group, usually {group}, must be one of yours "
            "(sudo usermod -aG ...)"
        )


def _package(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise SkylessError(f"a DW1000 on SPI needs the package {package}: pip install 'skyless[pi]'") from None
