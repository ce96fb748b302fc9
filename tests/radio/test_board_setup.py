"""Boards that compute: how they are set up, and what a host's program hears of them."""

import asyncio

import pytest
from radio_events import radio_events
from serial_stage import ComputingBoard, PlayedBoard

from skyless.cli.main import main
from skyless.core.errors import SkylessError
from skyless.radio.interface import Gone, Restarted
from skyless.radio.serial import link
from skyless.radio.serial.link import BoardSettings, TagConfig
from skyless.radio.serial.serial_radio import UNTIL_NEXT_START, Computing, SerialRadio, set_up
from skyless.radio.tag_reports import BoardFix, Reported
from skyless.run.board import BoardTag
from support.board_tag import ANCHORS

BAUD = 1_000_000


class Worn(BoardTag):
    """A tag whose flash keeps nothing."""

    flash = property(lambda _: BoardSettings(tag=2), lambda *_: None)


def serial(board):
    return SerialRadio(board.pty.name, (BAUD,), "tag1", computing=UNTIL_NEXT_START)


def found(board, changes=(), bauds=(BAUD,)):
    return set_up(board.pty.name, bauds, Computing(dict(changes), keeps=bool(changes)))


async def test_settings_are_read_changed_and_kept():
    async with ComputingBoard() as board:
        assert await found(board) == TagConfig(BoardSettings(), in_flash=True)
        wanted = BoardSettings(mode=1, tag=9)
        assert await found(board, {"mode": 1, "tag": 9}) == TagConfig(wanted, in_flash=True)
        assert board.tag.flash == wanted


@pytest.mark.site
async def test_a_board_that_cannot_be_set_up_is_named_in_words():
    async with ComputingBoard() as board:
        with pytest.raises(SkylessError, match="refuses its configuration: it has not these settings"):
            await found(board, {"mode": 1, "output": 1})  # NMEA, which no emulated board writes
    async with PlayedBoard() as board:
        with pytest.raises(SkylessError, match="computes no positions"):
            await found(board)
        board.pty.start(lambda data: None)
        with pytest.raises(SkylessError, match="no board answers"):
            await found(board)
    with pytest.raises(SkylessError, match="there is no /dev/nothing"):
        await set_up("/dev/nothing", (BAUD,), UNTIL_NEXT_START)


async def test_a_rate_that_fails_is_followed_by_the_next():
    async with ComputingBoard() as board:
        receive, deaf = board.protocol.on_host_data, iter([True])
        board.pty.start(lambda data: None if next(deaf, False) else receive(data))
        assert (await found(board, bauds=(115_200, BAUD))).settings == BoardSettings()


async def test_the_command_shows_what_flash_holds(capsys):
    async with ComputingBoard() as board:
        words = ["flash-config", "--radio", f"serial:{board.pty.name}"]
        assert await asyncio.to_thread(main, [*words, "--mode", "tag", "--sleep-s", "1.5"]) == 0
        assert board.tag.flash == BoardSettings(mode=1, sleep_ms=1500)
        assert "flash holds these settings" in capsys.readouterr().err
        assert await asyncio.to_thread(main, [*words, "--json"]) == 0
        assert '"in_flash":true,"settings":{"mode":"tag","output":"records"' in capsys.readouterr().out
        board.protocol.tag = Worn(board.report)
        assert await asyncio.to_thread(main, [*words, "--defaults"]) == 2
        assert "could not keep them in its flash" in capsys.readouterr().err


@pytest.mark.site
async def test_a_host_s_program_has_the_board_compute_until_its_next_start():
    async with ComputingBoard() as board, radio_events(serial(board)) as host:
        await host.until(Restarted)
        assert board.tag.settings == BoardSettings(mode=1, output=0)
        assert board.tag.flash == BoardSettings()
        board.report_all()
        await host.until(Reported, len(ANCHORS) + 3)
        assert isinstance(host.of(Reported)[-1].report, BoardFix)
        await asyncio.sleep(1.1)  # its HELLO is no answer then
        board.protocol.on_radio_event(Restarted())
        assert board.tag.settings == board.tag.flash
        await host.until(Restarted, 2)
        assert board.tag.settings.mode == 1
        assert host.radio.counters == {"board-restart": 1}


async def test_a_board_that_does_not_compute_is_refused_in_words():
    async with PlayedBoard() as board, radio_events(serial(board)) as host:
        assert "needs the firmware of this release" in (await host.until(Gone)).reason


async def test_a_plain_host_takes_no_notice_of_a_tag_s_records():
    async with ComputingBoard() as board, radio_events(SerialRadio(board.pty.name, (BAUD,), "tag1")) as host:
        await host.until(Restarted)
        board.report_all()
        board.report(link.FIX, b"short")
        async with asyncio.timeout(10):
            while not host.radio.counters:
                await asyncio.sleep(0.005)
        assert host.radio.counters == {"malformed-record": 1}
        assert host.of(Reported) == []
