"""Settings of a tag on a board: the same bytes at both ends, what is refused, and what a board does with them."""

import ctypes
import re
from struct import Struct

import pytest
from emulator.board_library import KEPT_BYTES, library
from firmware_stage import BoardStage, frame_of, needs_compiler
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import asdict, replace

from skyless.arguments import OptionError
from skyless.cli.nodes.boards import FlashOptions
from skyless.core.air.frame import Reception
from skyless.core.fix import NoFixReason
from skyless.radio.dw1000.radio import IDLE, LISTENING
from skyless.radio.serial import link
from skyless.radio.serial.link import SETTINGS_BYTES, BoardSettings, Hello, NotDone, TagConfig, pack, unpack
from skyless.radio.tag_reports import BoardStatus

pytestmark = [pytest.mark.site, needs_compiler]

WORDS = Struct("<11I2i3I3f")


def in_c(settings):
    """The struct in C, a byte more than its bytes: nothing may be written behind it."""
    return ctypes.create_string_buffer(WORDS.pack(1, *asdict(settings).values()), WORDS.size + 1)


asked = st.builds(
    FlashOptions,
    mode=st.none() | st.sampled_from(link.MODES),
    output=st.none() | st.sampled_from(link.OUTPUTS),
    rate_hz=st.none() | st.sampled_from([0, 1, 5, 10, 25, 50]),
    baud=st.none() | st.sampled_from([115_200, 230_400, 460_800, 1_000_000]),
    bluetooth_ms=st.none() | st.just(0) | st.integers(100, 10_240),
    site=st.none() | st.integers(0, 0xFFFD),
    tag=st.none() | st.integers(0, 0xFFFF),
    tx_delay_ticks=st.none() | st.integers(0, 0xFFFF),
    z_bounds_m=st.none() | st.tuples(st.floats(-1e5, 0.0), st.floats(0.01, 1e5)),
    sleep_s=st.none() | st.just(0.0) | st.floats(0.001, 3600.0),
    superframes=st.none() | st.integers(1, 100),
    receive=st.none() | st.sampled_from(["always", "expected"]),
    qa_m2ps3=st.none() | st.floats(2.0**-20, 1000.0, width=32),
    integrity_risk=st.none() | st.floats(2.0**-29, 0.0625, width=32),
    alert_limit_m=st.none() | st.floats(0.0, 1000.0, width=32),
)


@given(asked)
def test_both_ends_have_the_same_bytes_of_all_that_can_be_asked_for(options):
    """And of what a new board has."""
    settings = replace(BoardSettings(), **options.changes())
    packed = ctypes.create_string_buffer(SETTINGS_BYTES)
    library().settings_pack(in_c(settings), packed)
    assert packed.raw == pack(settings)
    assert library().settings_check(in_c(settings))
    again = ctypes.create_string_buffer(WORDS.size + 1)
    assert library().settings_unpack(packed, SETTINGS_BYTES, again)
    assert again.raw == in_c(settings).raw
    assert asdict(unpack(packed.raw)) == pytest.approx(asdict(settings), rel=1e-6)
    library().settings_pack(ctypes.byref(ctypes.c_char.in_dll(library(), "SETTINGS_DEFAULT")), packed)
    assert unpack(packed.raw) == BoardSettings()


def test_the_board_takes_nothing_that_is_not_right():
    wrong = {
        "mode": 2, "output": 4, "rate_hz": 51, "baud": 9600, "bluetooth_ms": 99, "site": link.ANY_SITE + 1,
        "tag": 65_536, "tx_delay_ticks": 65_536, "rx_delay_ticks": 65_536, "has_bounds": 1, "sleep_ms": 3_600_001,
        "superframes": 0, "predicts": 2, "qa_m2ps3": float("nan"), "integrity_risk": 0.2, "alert_limit_m": -1.0,
    }  # fmt: skip
    taken = {name for name in wrong if library().settings_check(in_c(replace(BoardSettings(), **{name: wrong[name]})))}
    assert taken == set()


@given(st.binary(max_size=100), st.integers(0, SETTINGS_BYTES * 8 - 1))
def test_damaged_bytes_are_no_settings(data, bit):
    flipped = int.from_bytes(pack(BoardSettings()), "little") ^ (1 << bit)
    for one in (data, flipped.to_bytes(SETTINGS_BYTES, "little")):
        assert not library().settings_unpack(one, len(one), in_c(BoardSettings()))
        assert unpack(one) is None


@pytest.mark.parametrize(
    "wrong",
    [
        {"bluetooth_ms": 50}, {"z_bounds_m": (2.0, 1.0)}, {"sleep_s": 1e9}, {"sleep_s": 1e-4}, {"tag": -1},
        {"qa_m2ps3": 0.0}, {"mode": "x"},
    ],
)  # fmt: skip
def test_what_cannot_be_set_is_refused_in_words(wrong):
    with pytest.raises(OptionError, match="it should be"):
        FlashOptions(**wrong)


# What a board does with them

TAG = BoardSettings(mode=1, tag=5)


def flash_of(settings):
    return pack(settings).ljust(KEPT_BYTES, b"\0")


def sent(settings, *, keep=False):
    return bytes((keep,)) + pack(settings)


def started(flash):
    """A board that starts with this in its flash, and what it has said first."""
    stage = BoardStage()
    stage.bus.settings = flash
    stage.board.begin()
    return stage, stage.reports()


def test_a_board_takes_right_settings_keeps_them_when_asked_and_says_what_flash_holds():
    stage, (hello,) = started(None)
    assert isinstance(hello, Hello)
    assert hello.can_compute
    assert stage.ask(link.ASK_TAG_CONFIG) == [TagConfig(BoardSettings(), in_flash=False)]
    wanted = BoardSettings(mode=1, output=3, tag=77)
    assert stage.ask(link.SET_TAG_CONFIG, sent(wanted)) == [TagConfig(wanted, in_flash=False)]
    assert stage.bus.settings is None
    kept = replace(wanted, tag=78)
    assert stage.ask(link.SET_TAG_CONFIG, sent(kept, keep=True)) == [TagConfig(kept, in_flash=True)]
    assert stage.bus.settings == flash_of(kept)
    assert stage.ask(link.SET_TIME, (1_790_000_000_000_001).to_bytes(8, "little")) == []
    assert stage.ask(link.SET_TIME, b"short") == []
    assert 0 <= stage.board.unix_us - 1_790_000_000_000_001 < 10_000


def test_a_board_keeps_what_it_has_when_it_refuses_and_says_where_flash_keeps_nothing(monkeypatch):
    stage, _ = started(None)
    monkeypatch.setattr(stage.bus, "write_settings", lambda settings: None)
    kept = stage.ask(link.SET_TAG_CONFIG, sent(BoardSettings(), keep=True))
    assert kept == [TagConfig(BoardSettings(), in_flash=False)]
    for body, reason in (
        (b"", link.REFUSED_MALFORMED),
        (sent(BoardSettings())[:-1], link.REFUSED_MALFORMED),
        (sent(BoardSettings(rate_hz=51)), link.REFUSED_SETTING),
    ):
        assert stage.ask(link.SET_TAG_CONFIG, body) == [NotDone(link.SET_TAG_CONFIG, reason)]
    assert stage.board.settings == BoardSettings()


def test_settings_in_flash_make_a_tag_at_the_start_and_what_it_holds_besides_a_radio():
    wrong = (bytes(KEPT_BYTES), b"\xff" * KEPT_BYTES, flash_of(replace(TAG, rate_hz=51)), flash_of(TAG)[::-1])
    for flash in (flash_of(TAG), *wrong):
        is_tag = flash not in wrong
        stage, (hello,) = started(flash)
        assert isinstance(hello, Hello)
        assert stage.ask(link.ASK_TAG_CONFIG) == [TagConfig(TAG if is_tag else BoardSettings(), in_flash=is_tag)]
        (status,) = stage.ask(link.ASK_STATUS)
        assert (status.configured, status.receiving) == (is_tag, is_tag)
        assert isinstance(stage.ask(link.ASK_HELLO)[0], Hello)


def test_a_host_that_configures_the_radio_has_a_radio_until_the_next_start():
    stage, _ = started(flash_of(replace(TAG, output=1)))
    stage.ready()
    assert stage.ask(link.ASK_TAG_CONFIG) == [TagConfig(BoardSettings(tag=5, output=1), in_flash=False)]
    stage.pass_us(1000)
    stage.arrive(frame_of(bytes(40)))
    stage.turn(8)
    assert isinstance(stage.reports()[0], Reception)
    assert stage.bus.settings == flash_of(replace(TAG, output=1))
    again, _ = started(stage.bus.settings)
    assert again.ask(link.ASK_TAG_CONFIG) == [TagConfig(replace(TAG, output=1), in_flash=True)]


def test_a_tag_that_becomes_a_radio_again_receives_nothing_before_its_host_asks():
    stage, _ = started(flash_of(TAG))
    assert stage.board.chip.state == LISTENING
    assert stage.ask(link.SET_TAG_CONFIG, sent(BoardSettings())) == [TagConfig(BoardSettings(), in_flash=False)]
    assert stage.board.chip.state == IDLE


def test_a_tag_says_once_a_second_how_it_is():
    stage, _ = started(flash_of(TAG))
    stage.pass_us(2_500_000)
    found = stage.reports()
    assert [type(one) for one in found] == [BoardStatus] * 2
    assert {one.reason for one in found} == {NoFixReason.NO_BEACONS}


@pytest.mark.parametrize(("output", "line"), [(1, rb"\$PSKY,,,5,,,,,,,,U\*..\r\n"), (2, rb'\{"type":"no_fix",.*\}\n')])
def test_text_comes_in_whole_lines_of_its_own_beside_records(output, line):
    stage, _ = started(flash_of(replace(TAG, output=output)))
    for _ in range(2):
        stage.pass_us(1_100_000)
        stage.send(link.ASK_STATUS)
        stage.turn(8)
    text, records = b"", []
    for piece in re.split(rb"(?<=\n)\0|\0", bytes(stage.bus.from_board)):
        if piece.endswith(b"\n"):
            text += piece
        elif piece:
            records += link.Reader().read(piece + b"\0")
    assert [record[0] for record in records] == [link.STATUS] * 2
    assert re.fullmatch(rb"(%s){2}" % line, text)


def test_records_of_a_board_that_writes_text_begin_behind_it():
    stage = BoardStage()
    stage.ask(link.SET_TAG_CONFIG, sent(BoardSettings(mode=1, output=1)))
    stage.bus.from_board += b"$GNRMC,,V,,,,,,,,,,N*4D\r\n"
    stage.send(link.ASK_TAG_CONFIG)
    stage.turn(8)
    (record,) = link.Reader().read(bytes(stage.bus.from_board))
    assert record[0] == link.TAG_CONFIG
