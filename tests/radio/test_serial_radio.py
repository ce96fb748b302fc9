"""Serial radios over pseudo-terminals: the same fixes bit for bit, boards that are unplugged, noise on the line."""

import asyncio
import os
import random
import time
from collections import Counter
from pathlib import Path

import msgspec
import pytest
from radio_events import fixes_of, radio_events
from serial_stage import PlayedBoard, linked, quantised

from skyless.core.air.frame import Diagnostics, Reception, Transmission, fcs
from skyless.core.errors import SkylessError
from skyless.core.protocol1.anchor import Anchor
from skyless.radio.foreign.foreign_radios import ListenerRadio
from skyless.radio.interface import AntennaDelays, Gone, Late, Restarted, Sent
from skyless.radio.serial.serial_port import Pty
from skyless.radio.serial.serial_radio import SerialRadio
from skyless.run.board import ListenerProtocol
from skyless.run.open_radio import is_simulated, open_radios, open_sniffers
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.lab import paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World

LAB = paper_lab_site()


def frame_of(body):
    return body + fcs(body)


def receptions(seconds):
    """What a tag at (2, 3, 0) hears in the simulated lab, measurements as exact as the line carries them."""
    faults = msgspec.structs.replace(impairments_of(Request(LAB), LAB), diagnostics=True)
    world = World(LAB, lambda anchor: Anchor(LAB, anchor), [TagSpec(Static(2.0, 3.0, 0.0))], faults, 1)
    heard = [reception for broadcast in world.run(seconds) for _, reception, _ in broadcast.receptions()]
    return [msgspec.structs.replace(one, diagnostics=quantised(one.diagnostics)) for one in heard]


HEARD = receptions(4.0)


class ListenerBoard(PlayedBoard):
    def __init__(self):
        super().__init__()
        self.protocol = ListenerProtocol(self.pty.send)


def listener_pair():
    board = ListenerBoard()
    return board, ListenerRadio(board.pty.name, 115_200, "tag1")


@pytest.mark.site
def test_fixes_over_a_listener_are_those_of_the_radio_itself_bit_for_bit():
    """Those over the serial link: ``test_three_radios.py``."""

    async def play():
        board, radio = listener_pair()
        async with board, radio_events(radio) as host:
            await host.until(Restarted)
            for at in range(0, len(HEARD), 20):
                for reception in HEARD[at : at + 20]:
                    board.hear(reception)
                await host.until(Reception, min(at + 20, len(HEARD)))
            return host.of(Reception), radio.counters

    arrived, counters = asyncio.run(play())
    assert [(one.frame, one.rx_ticks) for one in arrived] == [(one.frame, one.rx_ticks) for one in HEARD]
    assert not +counters
    here = fixes_of(HEARD)
    assert fixes_of(arrived) == here
    assert sum(fix is not None for fix in here[0]) > 100


async def test_frames_are_sent_at_their_tick_and_their_end_is_reported():
    async with linked() as (board, host):
        ticks = 512 * 10**6 + AntennaDelays().tx_ticks
        for event in (Sent, Late):
            host.radio.transmit(Transmission(frame_of(b"a frame"), ticks))
            while not board.radio.transmissions:
                await asyncio.sleep(0.001)
            assert board.radio.transmissions.pop() == Transmission(frame_of(b"a frame"), ticks)
            board.protocol.on_radio_event(event(ticks))
            assert await host.until(event) == event(ticks)
        host.radio.transmit(Transmission(frame_of(b"one"), ticks))
        host.radio.transmit(Transmission(frame_of(b"two"), ticks + 512))  # there is room for one
        assert await host.until(Late, 2) == Late(ticks + 512)
        async with asyncio.timeout(20):
            while (host.radio._session.status.sent, host.radio._session.status.late) != (1, 2):
                await asyncio.sleep(0.02)  # it is asked for now and then
        assert host.radio._session.status.garbled == 0


async def test_a_board_that_only_listens_sends_nothing():
    async with linked(can_transmit=False) as (board, host):
        host.radio.transmit(Transmission(frame_of(b"one"), 77 * 512))
        assert await host.until(Late) == Late(77 * 512)
        assert board.radio.transmissions == []


async def test_the_counter_is_that_of_the_board():
    async with linked() as (board, host):
        assert 5 <= host.radio.now_ticks() < 5 + 10 * 63_897_600_000
        board.radio.ticks = 2**39
        async with asyncio.timeout(10):
            while not 0 <= host.radio.now_ticks() - 2**39 < 10 * 63_897_600_000:
                await asyncio.sleep(0.05)


@pytest.mark.site
async def test_a_board_that_is_pulled_out_and_plugged_in_is_found_again(tmp_path):
    place = tmp_path / "board"
    async with radio_events(SerialRadio(str(place), (1_000_000,), "tag1")) as host:
        assert f"there is no {place}" in (await host.until(Gone)).reason
        for time_s in (1, 2, 3):
            async with PlayedBoard(place) as board:
                await host.until(Restarted, time_s)
                board.hear(Reception(b"%d" % time_s, time_s))
                assert (await host.until(Reception, time_s)).frame == b"%d" % time_s
            await host.until(Gone, 2 * time_s)
            assert f"{place} was unplugged" in [event.reason for event in host.of(Gone)]
            assert host.radio.now_ticks() is None
            host.radio.transmit(Transmission(b"x", 9))
            assert host.events[-1] == Late(9)
        assert len(host.of(Gone)) <= 8  # each reason once, however often it is tried


async def test_a_board_that_starts_again_behind_an_open_port_is_set_up_again():
    async with linked() as (board, host):
        board.protocol.on_radio_event(Restarted())
        await host.until(Restarted, 2)
        board.hear(Reception(b"again", 7))
        assert (await host.until(Reception)).frame == b"again"
        assert host.of(Gone) == []


async def test_noise_on_the_line_costs_what_it_hits_and_is_counted():
    async with linked() as (board, host):
        noise, heard = random.Random(3), 0
        for number in range(300):
            if number % 3 == 0:
                board.pty.send(noise.randbytes(noise.randrange(1, 300)))
            board.hear(Reception(b"frame %d" % number, number))
            heard += number % 3 != 0
            if number % 30 == 0:
                await asyncio.sleep(0.005)
        await host.until(Reception, heard)
        frames = {one.frame for one in host.of(Reception)}
        assert frames >= {b"frame %d" % number for number in range(300) if number % 3}
        assert host.radio.counters["garbled-record"] >= 90
        assert len(host.of(Restarted)) == 1


async def test_a_port_that_is_taken_or_no_port_is_reported_in_words():
    async with linked() as (board, _), radio_events(SerialRadio(board.pty.name, (1_000_000,), "tag2")) as second:
        assert "is used by another program" in (await second.until(Gone)).reason
    async with radio_events(SerialRadio("/dev/null", (1_000_000,), "tag2")) as null:
        assert "/dev/null is no serial port" in (await null.until(Gone)).reason


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open everything")
async def test_a_port_that_may_not_be_opened_is_reported_in_words():
    async with PlayedBoard() as board:
        Path(board.pty.path).chmod(0)
        async with radio_events(SerialRadio(board.pty.path, (1_000_000,), "tag1")) as host:
            assert "dialout" in (await host.until(Gone)).reason


async def test_what_nobody_fetches_is_dropped_and_who_comes_later_receives_the_present():
    async with PlayedBoard() as board:
        board.protocol._configured = board.protocol._receiving = True
        for number in range(2000):
            board.hear(Reception(bytes(100), number))
        assert board.pty.overruns >= 1
        assert board.protocol.counts["unsent"] == board.pty.overruns
        async with radio_events(SerialRadio(board.pty.name, (1_000_000,), "tag1")) as host:
            await host.until(Restarted)
            board.hear(Reception(b"now", 5000))
            assert [one.frame for one in [await host.until(Reception)]] == [b"now"]


async def test_a_link_keeps_its_name_and_goes_with_the_board(tmp_path):
    place = tmp_path / "board"
    first = Pty(place)
    second = Pty(place)
    first.close()
    assert place.readlink() == Path(second.path)
    second.close()
    assert not place.is_symlink()
    place.write_text("a file")
    with pytest.raises(SkylessError, match="this path exists"):
        Pty(place)
    with pytest.raises(SkylessError, match="cannot be made"):
        Pty(tmp_path / "nowhere" / "board")


@pytest.mark.parametrize(
    ("spec", "right"),
    [
        ("serial:", "it should name one port, as serial:/dev/ttyACM0"),
        ("serial:/dev/a,/dev/b", "it should name one port"),
        ("serial:/dev/a@fast", "PATH@BAUD"),
        ("serial:/dev/a@1", "PATH@BAUD"),
        ("serial:/", "/ is a folder"),
        (f"serial:{__file__}", "is a file"),
        (
            "serial:socket://board.local:4000",
            "a serial port of this computer, as /dev/ttyACM0, and socket://board.local",
        ),
        ("listener:socket://10.0.0.1:4000@115200", "a serial port of this computer"),
        ("serial:rfc2217://10.0.0.1:4000", "a serial port of this computer"),
        ("listener:", "it should name one port"),
        ("usb:/dev/a", "ether:HOST[:PORT], serial:PATH[@BAUD], spi:BUS.DEVICE[,irq=PIN][,reset=PIN]"),
    ],
)
def test_ports_that_cannot_be_are_reported_at_once(spec, right):
    with pytest.raises(SkylessError) as told:
        open_radios(spec, "tag", ("tag1",))
    assert right in str(told.value)
    assert spec in str(told.value)


def test_ports_that_nobody_can_look_at_are_opened_to_be_reported_why(tmp_path, monkeypatch):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")

    def forbidden(_path):
        raise PermissionError(13, "Permission denied")

    for place in (str(tmp_path / "loop"), "/x" * 3000):
        spec = f"serial:{place}"
        assert open_radios(spec, "tag", ("tag1",))
        assert not is_simulated(spec)
    monkeypatch.setattr("pathlib.Path.exists", forbidden)
    assert open_radios("serial:/root/board", "tag", ("tag1",))


def test_names_of_ports():
    (one,) = open_radios("serial:/dev/nothing@2000000", "tag", ("tag1",))
    assert (one._port.path, one._port.baud, one._delays) == ("/dev/nothing", 2_000_000, AntennaDelays())
    delays = [AntennaDelays(1, 2), AntennaDelays(3, 4)]
    two = open_radios("serial:/dev/a,/dev/b", "anchor", ("1", "2"), delays)
    assert [(radio._port.path, radio.name, radio._delays) for radio in two] == [
        ("/dev/a", "1", delays[0]),
        ("/dev/b", "2", delays[1]),
    ]
    with pytest.raises(SkylessError, match="a serial port of this computer"):
        open_sniffers("sniffer:socket://10.0.0.1:4000", ("drone",))
    (sniffer,) = open_sniffers("sniffer:/dev/c", ("t",))
    assert (sniffer._port.path, sniffer._port.baud) == ("/dev/c", 115_200)
    for driver in ("listener", "sniffer"):
        with pytest.raises(SkylessError, match="only listens"):
            open_radios(f"{driver}:/dev/a", "anchor", ("1",))
    with pytest.raises(SkylessError, match="each port once"):
        open_radios("serial:/dev/a,/dev/a", "tag", ("a", "b"))
    assert not is_simulated("serial:/dev/ttyACM0")
    assert is_simulated("serial:/dev/pts/7@1000000")


async def test_a_listener_receives_whole_lines_only_and_transmits_nothing():
    board, radio = listener_pair()
    async with board, radio_events(radio) as host:
        await host.until(Restarted)
        assert radio.now_ticks() is None
        board.pty.send(b'"dlen":2,"d":"abcd"}\r\n')  # what was on its way when the port was opened
        board.hear(Reception(b"a frame", 2**40 - 1, None, Diagnostics(-81.25)))
        board.pty.send(b'{"utime":1,"ts":3,"dlen":3,"d":"abcd"}\r\n{"ts":[]}\r\n\r\n')
        board.pty.send(b'{"ts":-1,"dlen":1,"d":"ab"}\n{"ts":1099511627777,"dlen":1,"d":"ab","x":{}}\n')
        assert (await host.until(Reception, 2)).rx_ticks == 1
        first = host.of(Reception)[0]
        assert (first.frame, first.rx_ticks, first.diagnostics) == (b"a frame", 2**40 - 1, Diagnostics(-81.2))
        assert abs(first.host_s - time.monotonic()) < 30.0
        assert radio.counters == Counter({"wrong-length": 1, "malformed-line": 1, "impossible-stamp": 1})
        radio.transmit(Transmission(b"x", 3))
        assert host.events[-1] == Late(3)
        assert radio.now_ticks() is not None
