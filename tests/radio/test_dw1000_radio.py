"""A DW1000 as a radio: on the emulated air by its model, and on an SPI that the test plays."""

import asyncio
import contextlib
import os
import sys
import time
from types import ModuleType

import pytest
from air_stage import LAB, make_ether
from chip_stage import HandClock, TimedNode
from radio_events import radio_events

from skyless.core.air.frame import Diagnostics, Reception, Transmission, fcs
from skyless.core.errors import SkylessError
from skyless.core.ticks import TICK_RATE_HZ, difference, wrap
from skyless.radio.dw1000 import spi
from skyless.radio.dw1000.radio import Dw1000Radio
from skyless.radio.dw1000.spi import SpiPort
from skyless.radio.emulated import Arrival, EtherConnection, HeardRow, Join
from skyless.radio.interface import AntennaDelays, Gone, Hint, Late, Restarted, Sent
from skyless.run.dw1000_model import ModelPort
from skyless.run.open_radio import is_simulated, open_radios
from skyless.sim.dw1000.chip import ModelBus
from support.waiting import until

pytestmark = pytest.mark.site


async def test_frames_fly_between_models_on_the_emulated_air_and_late_ones_do_not():
    ether = make_ether(asyncio.get_running_loop().time)
    server = await ether.serve("127.0.0.1", 0)
    place = f"model:127.0.0.1:{server.sockets[0].getsockname()[1]}"
    (anchor,) = open_radios(place, "anchor", (str(LAB.anchors[0].id),), [AntennaDelays()])
    (tag,) = open_radios(place, "tag", ("tag1",))
    async with radio_events(anchor) as sender, radio_events(tag) as listener:
        await sender.until(Restarted)
        await listener.until(Restarted)
        for number in range(20):
            now_ticks = anchor.now_ticks()
            tx_ticks = wrap((now_ticks + round(0.02 * TICK_RATE_HZ)) & ~0x1FF) + 16_436
            body = b"frame %d  " % number
            anchor.transmit(Transmission(body, wrap(tx_ticks)))
            await until(lambda number=number: len(sender.of(Sent)) + len(sender.of(Late)) > number)
        assert len(sender.of(Sent)) > 5
        await listener.until(Reception)
        assert listener.of(Reception)[0].frame.startswith(b"frame ")
        late = len(sender.of(Late))
        anchor.transmit(Transmission(b"too late", anchor.now_ticks()))
        assert len(sender.of(Late)) == late + 1
        assert not +tag._port.chip.misuse
        assert not +anchor._port.chip.misuse
    server.close()
    ether._timer.cancel()


class PlayedSpi(ModelBus):
    """A bus as spidev gives it, to a model in an air that the test plays."""

    def __init__(self, node):
        super().__init__(node.chip, node.pause)
        self.closed = self.broken = False

    def transfer(self, out):
        if self.broken:
            raise OSError(5, "Input/output error")
        return super().transfer(out)

    def fileno(self):
        return None

    def close(self):
        self.closed = True


def spi_radio(monkeypatch, bus=PlayedSpi):
    monkeypatch.setattr(spi, "REOPEN_S", 0.01)
    node, buses = TimedNode(HandClock()), []

    def open_bus():
        buses.append(bus(node))
        return buses[-1]

    return Dw1000Radio(SpiPort("/dev/spidev0.0", open_bus), "tag1", AntennaDelays()), node, buses


async def test_a_chip_on_spi_is_asked_where_it_has_no_interrupt_line_and_found_again(monkeypatch):
    radio, node, buses = spi_radio(monkeypatch)
    async with radio_events(radio) as host:
        await host.until(Restarted)
        assert abs(difference(radio.now_ticks(), node.air.now_ticks())) < 512
        node.air.pass_s(1e-3)
        node.chip.receive(b"\x01\x02\x03\x2a\x14", node.air.now_ticks(), Diagnostics(-80.0))
        buses[0].broken = True
        assert "Input/output error" in (await host.until(Gone)).reason
        assert radio.now_ticks() is None
        radio.transmit(Transmission(b"frame", 1))
        assert host.events[-1] == Late(1)
        await host.until(Restarted, 2)
        assert buses[0].closed
    assert buses[-1].closed


async def test_a_chip_whose_supply_failed_is_started_again_even_where_it_logs_nothing(monkeypatch):
    radio, node, _ = spi_radio(monkeypatch)
    monkeypatch.setattr("skyless.radio.dw1000.radio.CHECK_S", 0.01)
    async with radio_events(radio) as host:
        for time_s in (1, 2):
            await host.until(Restarted, time_s)
            if time_s == 1:
                node.chip.pull_reset()
                node.air.pass_s(1e-3)
        assert "lost its configuration" in host.of(Gone)[0].reason
        assert radio.counters["chip-lost"] == 1


async def test_a_chip_that_is_missed_by_the_looks_after_it_is_found_again(monkeypatch):
    radio, _, buses = spi_radio(monkeypatch)
    monkeypatch.setattr("skyless.radio.dw1000.radio.CHECK_S", 0.01)
    monkeypatch.setattr(spi, "CHIP_POLL_S", 0.2)  # so that the look after it comes first
    async with radio_events(radio) as host:
        await host.until(Restarted)
        buses[0].broken = True
        await host.until(Restarted, 2)
        assert [gone.reason for gone in host.of(Gone)] == ["/dev/spidev0.0: [Errno 5] Input/output error"]
        assert buses[0].closed


async def test_a_bus_that_fails_while_a_frame_is_overdue_is_opened_again(monkeypatch):
    radio, node, _ = spi_radio(monkeypatch)
    faults = []
    asyncio.get_running_loop().set_exception_handler(lambda _loop, context: faults.append(context))
    async with radio_events(radio) as host:
        await host.until(Restarted)
        session = radio._session
        radio.transmit(Transmission(b"frame", wrap((node.air.now_ticks() + (1 << 26) & ~0x1FF) + 16_436)))
        monkeypatch.setattr(session, "cancel_overdue", lambda: (_ for _ in ()).throw(OSError(5, "Input/output error")))
        node.air.pass_s(5e-3)
        radio._on_overdue(session)
        await host.until(Restarted, 2)
        assert len(host.of(Gone)) == 1
    assert not faults


class LinedSpi(PlayedSpi):
    """The same with an interrupt line, which a pipe plays.

    ``stuck`` holds it high whatever the chip says, ``noisy`` lets it rise all the time.
    """

    def __init__(self, node):
        super().__init__(node)
        self.read, self.write_end = os.pipe()
        os.set_blocking(self.read, False)
        self.stuck, self.noisy, self.looks = False, False, 0

    def fileno(self):
        return self.read

    def is_raised(self):
        self.looks += 1
        return self.stuck or self.chip.irq

    def forget_edges(self):
        if not self.noisy:
            with contextlib.suppress(BlockingIOError):
                os.read(self.read, 4096)

    def rise(self):
        os.write(self.write_end, b"!")

    def close(self):
        super().close()
        os.close(self.read)
        os.close(self.write_end)


def hear(node, data):
    """A good frame comes in."""
    node.air.pass_s(1e-3)
    node.chip.receive(data + fcs(data), node.air.now_ticks(), Diagnostics(-80.0))


async def test_an_interrupt_line_that_is_stuck_is_reported_once_and_the_chip_is_asked_at_intervals(monkeypatch):
    """Without a bound every turn of the loop asks the chip: thousands of times in these 0.2 s."""
    radio, node, buses = spi_radio(monkeypatch, LinedSpi)
    monkeypatch.setattr(spi, "CHIP_POLL_S", 0.02)
    async with radio_events(radio) as host:
        await host.until(Restarted)
        buses[0].stuck = True
        hint = await host.until(Hint)
        assert "the interrupt line of /dev/spidev0.0 rises though" in hint.text
        looks, begun_s = buses[0].looks, time.monotonic()
        await asyncio.sleep(0.2)
        assert buses[0].looks - looks <= (time.monotonic() - begun_s) / 0.02 + 1
        hear(node, b"it is heard all the same")
        assert (await host.until(Reception)).frame.startswith(b"it is heard")
        buses[0].stuck = False
        looks = buses[0].looks
        await until(lambda: buses[0].looks >= looks + 3)  # back to waiting for the line
        buses[0].stuck = True
        await until(lambda: radio.counters["irq-in-vain"] >= 2)
        assert len(host.of(Hint)) == 1
        assert len(host.of(Restarted)) == 1


async def test_an_interrupt_line_that_picks_up_noise_is_reported_and_does_not_make_the_program_spin(monkeypatch):
    radio, _, buses = spi_radio(monkeypatch, LinedSpi)
    monkeypatch.setattr(spi, "CHIP_POLL_S", 0.02)
    async with radio_events(radio) as host:
        await host.until(Restarted)
        buses[0].noisy = True
        buses[0].rise()
        await host.until(Hint)
        looks, begun_s = buses[0].looks, time.monotonic()
        await asyncio.sleep(0.2)
        assert buses[0].looks - looks <= (time.monotonic() - begun_s) / 0.02 + 1
        assert radio.counters["irq-in-vain"] == 1


async def test_an_interrupt_line_that_is_high_for_good_reason_is_not_called_stuck(monkeypatch):
    radio, node, buses = spi_radio(monkeypatch, LinedSpi)
    async with radio_events(radio) as host:
        await host.until(Restarted)
        for number in range(3 * spi.MAX_VAIN_INTERRUPTS):
            hear(node, b"frame %d" % number)
            buses[0].rise()
            await host.until(Reception, number + 1)
        assert not +radio.counters
        assert host.of(Hint) == []


async def test_what_answers_but_is_no_dw1000_is_reported_in_words(monkeypatch):
    radio, node, _ = spi_radio(monkeypatch)
    monkeypatch.setattr(node.chip, "transfer", lambda out, _hz: b"\xff" * len(out))
    async with radio_events(radio) as host:
        assert "/dev/spidev0.0" in (await host.until(Gone)).reason
        await asyncio.sleep(0.05)
        assert len(host.events) == 1


FORM = r"it should be spi:BUS\.DEVICE, as spi:0\.0,irq=25"


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        *((f"spi:{end}", FORM) for end in ("", "0", "a.b", "0.0,irq", "0.0,irq=x", "0.0,pin=3", "0.0,chip=gpiochip0")),
        ("spi:0.0,irq=1,irq=2", "it should give irq once"),
        ("spi:0.0,irq=1,chip=/dev/a,chip=/dev/a", "it should give chip once"),
        *((f"spi:0.0,hz={rate}", "hz from 2000000 to 20000000") for rate in (1, 1_999_999, 20_000_001)),
        ("model:127.0.0.1:99999", r"it should be model:HOST\[:PORT\] with a port from 1 to 65535"),
        ("model:socket://here:7784", r"it should be .*:HOST\[:PORT\], and socket://here is no host"),
        ("ether:socket://here:7784", r"it should be .*:HOST\[:PORT\], and socket://here is no host"),
    ],
)
def test_names_of_chips_and_ethers_that_cannot_be(spec, words):
    with pytest.raises(SkylessError, match=words):
        open_radios(spec, "tag", ("tag1",))


@pytest.fixture
def pi(monkeypatch):
    """A computer with both packages and all device files, which tests take away."""
    files = {"/dev/spidev0.0", "/dev/spidev0.1", "/dev/gpiochip0", "/dev/gpiochip4"}
    monkeypatch.setattr(spi.os.path, "exists", files.__contains__)
    monkeypatch.setattr(spi.os, "access", lambda path, mode: True)
    for name in ("spidev", "gpiod", "gpiod.line"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    return files


@pytest.mark.parametrize(
    ("package", "spec", "refused"),
    [
        ("spidev", "spi:0.0", True),
        ("gpiod", "spi:0.0,irq=25", True),
        ("gpiod.line", "spi:0.0,reset=24", True),  # version 1 of the package has none
        ("gpiod", "spi:0.0", False),
    ],
)
@pytest.mark.usefixtures("pi")
def test_a_package_that_is_missing_is_reported_at_the_start(monkeypatch, package, spec, refused):
    monkeypatch.setitem(sys.modules, package, None)
    if not refused:
        assert open_radios(spec, "tag", ("tag1",))
        return
    library = package.partition(".")[0]
    words = rf"--radio is '{spec}'; .*needs {library}, which is not installed"
    with pytest.raises(SkylessError, match=words):
        open_radios(spec, "tag", ("tag1",))


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("spi:9.0", r"there is no /dev/spidev9\.0 .*SPI should be switched on"),
        ("spi:0.0,irq=25,chip=/dev/gpiochip7", r"there is no /dev/gpiochip7 .*chip= should name"),
    ],
)
@pytest.mark.usefixtures("pi")
def test_a_device_file_that_is_missing_is_reported_at_the_start(spec, words):
    with pytest.raises(SkylessError, match=f"--radio is '{spec}'; {words}"):
        open_radios(spec, "tag", ("tag1",))


@pytest.mark.parametrize(("path", "group"), [("/dev/spidev0.0", "spi"), ("/dev/gpiochip0", "gpio")])
@pytest.mark.usefixtures("pi")
def test_a_device_file_that_may_not_be_opened_is_reported_at_the_start(monkeypatch, path, group):
    monkeypatch.setattr(spi.os, "access", lambda asked, mode: asked != path)
    with pytest.raises(SkylessError, match=f"{path} may not be opened: its group, usually {group}"):
        open_radios("spi:0.0,irq=25", "tag", ("tag1",))


async def test_what_fails_once_it_has_started_is_tried_again(monkeypatch):
    radio, _, buses = spi_radio(monkeypatch)
    whole, failures = radio._port._open_bus, []

    def open_bus():
        if len(failures) < 3:
            failures.append(SkylessError("GPIO lines 25 (irq) cannot be had"))
            raise failures[-1]
        return whole()

    radio._port._open_bus = open_bus
    async with radio_events(radio) as host:
        await host.until(Restarted)
        assert (len(host.of(Gone)), len(failures), len(buses)) == (1, 3, 1)


@pytest.mark.parametrize("spec", ["serial:/dev/a", "model:127.0.0.1", "spi:0.0"])
@pytest.mark.usefixtures("pi")
def test_tags_have_phases_and_anchors_where_they_are_asked_for(spec):
    for kind in ("tag", "anchor"):
        for phases, has_phases in ((None, kind == "tag"), (True, True), (False, False)):
            assert open_radios(spec, kind, ("1",), phases=phases)[0]._phases is has_phases


def test_a_phase_on_the_emulated_air_reaches_the_program_by_both_radios():
    """Over the model it is rounded: the sample has 16 bits a part, the driver 2**-16 turns."""
    connection = EtherConnection("127.0.0.1", 7784, Join("tag", ("tag1",)))
    (node,) = connection.radios
    port = ModelPort(node, AntennaDelays())
    port._radio, heard = Dw1000Radio(port, "tag1", AntennaDelays(), phases=True), []
    port._radio._listener = heard.append
    frame = b"some frame" + fcs(b"some frame")

    def arrive(phase_cycles):
        row = HeardRow(0, wrap(node.now_ticks() + 10**7), -80.0, -82.0, 1.0, phase_cycles)
        connection.on_message(Arrival(frame, time.monotonic(), (row,)), 0.0)
        return heard[-1].carrier_phase_cycles

    node.set_clock(10**9, time.monotonic())
    node._listener = heard.append
    assert [arrive(phase_cycles) for phase_cycles in (0.123456789, None)] == [0.123456789, None]
    node._listener = port._on_event
    port._on_event(Restarted())
    assert arrive(0.123456789) == pytest.approx(0.123456789, abs=2e-4)
    assert arrive(None) is None
    assert not +port.chip.misuse


@pytest.mark.usefixtures("pi")
def test_names_of_chips():
    (one,) = open_radios(
        "spi:0.1,irq=25,reset=24,hz=4000000,chip=/dev/gpiochip4", "anchor", ("3",), [AntennaDelays(1, 2)]
    )
    assert (one.name, one._delays, one._port._name) == ("3", AntennaDelays(1, 2), "/dev/spidev0.1")
    with pytest.raises(SkylessError, match="carries one node, not 2"):
        open_radios("spi:0.0", "anchor", ("1", "2"))
    assert is_simulated("model:127.0.0.1")
    assert not is_simulated("spi:0.0")
