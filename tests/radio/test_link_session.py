"""A conversation over the serial link with a board that the test plays record by record."""

import random
import re
import struct
from collections import Counter

import pytest
from serial_stage import quantised

from skyless.core.air.frame import Diagnostics, Reception, Transmission
from skyless.radio.interface import AntennaDelays, Gone, Hint, Late, Restarted, Sent
from skyless.radio.serial import link
from skyless.radio.serial.serial_radio import BOARD_SILENCE_S, MAX_PENDING_FRAMES, STATUS_S, LinkSession

DELAYS = AntennaDelays(16_450, 16_500)
COUNTS = [7, 1, 3, 2, 0, 5]
ON = link.IS_CONFIGURED | link.IS_RECEIVING
T0 = 0xFE_1234_5600


class Talk:
    """A session whose port is the test."""

    def __init__(self, **needs):
        self.events, self.counters, self.now_s = [], Counter(), 50.0
        self.commands = []
        self._reader = link.Reader()
        self.board = link.Writer()
        self.session = LinkSession("/dev/board", DELAYS, self._take, self.events.append, self.counters, **needs)
        self.session.begin(self.now_s)

    def _take(self, data):
        self.commands += self._reader.read(data)

    def kinds(self):
        """Commands since last asked."""
        kinds = [command[0] for command in self.commands]
        self.commands.clear()
        return kinds

    def hear(self, data):
        self.session.on_data(data, self.now_s)

    def hello(self, cause=0, abilities=link.CAN_TRANSMIT):
        self.hear(self.board.hello((1, 2, 3), b"board-01", abilities, cause))

    def start_again(self):
        self.board = link.Writer()
        self.hello()

    def status(self, state=ON, ticks=T0):
        self.hear(self.board.status(ticks, state, COUNTS, 2150, 3300))

    def ready(self):
        self.hello()
        self.status(link.IS_CONFIGURED)
        self.status()
        self.kinds()
        return self

    def is_well(self, seconds):
        """Let time pass in which the board tells its status every second."""
        for _ in range(seconds):
            self.poll(1.0)
            self.status()

    def poll(self, seconds):
        """Let time pass; what the session says to it in the end."""
        said = None
        for _ in range(round(seconds / STATUS_S)):
            self.now_s += STATUS_S
            said = said or self.session.poll(self.now_s)
        return said


def test_a_board_is_greeted_configured_and_ready():
    talk = Talk()
    assert talk.kinds() == [link.ASK_HELLO]
    talk.hello()
    (config,) = (command for command in talk.commands if command[0] == link.CONFIG)
    assert tuple(config[2:8]) == (5, 64, 2, 9, 128, 0)
    assert struct.unpack_from("<2H", config, 8) == (16_450, 16_500)
    assert talk.kinds() == [link.CONFIG, link.RX_ON]
    talk.status(link.IS_CONFIGURED)
    assert talk.events == []
    assert talk.session.clock.read(talk.now_s) is None
    talk.status()
    assert talk.events == [Restarted()]
    assert talk.session.clock.read(talk.now_s) == T0
    hello, status = talk.session.hello, talk.session.status
    assert (hello.firmware, hello.device_id, hello.can_transmit) == ((1, 2, 3), b"board-01", True)
    counts = status.received, status.errors, status.sent, status.late, status.garbled, status.unsent_records
    assert list(counts) == COUNTS
    assert (status.temperature_c, status.supply_v) == (21.5, 3.3)
    talk.poll(STATUS_S)
    assert talk.kinds() == [link.ASK_STATUS]


def test_receptions_come_through_with_their_measurements_in_the_line_s_units():
    talk = Talk().ready()
    frame = bytes(range(40))
    talk.hear(talk.board.rx(2**40 - 1, -7953, -8312, -12_345, frame))
    talk.hear(talk.board.rx(0, link.NOT_MEASURED, link.NOT_MEASURED, link.NOT_MEASURED, frame[:1]))
    assert talk.events[1:] == [
        Reception(frame, 2**40 - 1, talk.now_s, Diagnostics(-79.53, -83.12, -12.345)),
        Reception(frame[:1], 0, talk.now_s, Diagnostics()),
    ]
    told = Diagnostics(-79.5314, None, 40.0)
    assert quantised(told) == Diagnostics(-79.53, None, None)  # ±32.767 ppm fit
    assert quantised(quantised(told)) == quantised(told)


@pytest.mark.parametrize("abilities", [link.CAN_TRANSMIT, link.CAN_TRANSMIT | link.HAS_PHASES])
@pytest.mark.parametrize("phases", [False, True])
def test_phases_are_asked_only_of_a_board_that_has_them_and_come_through(phases, abilities):
    talk = Talk(phases=phases)
    talk.hello(abilities=abilities)
    (config,) = (command for command in talk.commands if command[0] == link.CONFIG)
    assert config[12] == (phases and abilities > 1)
    talk.status()
    talk.hear(talk.board.rx(5, -7953, -8312, 12, b"frame", 0xC000))
    assert talk.events[1:] == [Reception(b"frame", 5, talk.now_s, Diagnostics(-79.53, -83.12, 0.012), 0.75)]


def test_a_host_of_version_1_1_counts_a_record_that_it_does_not_know(monkeypatch):
    """Such a host never asks; a board that sends it all the same costs it nothing else."""
    monkeypatch.delitem(link._DECODERS, link.RX_PHASE)
    talk = Talk().ready()
    talk.hear(talk.board.rx(5, 1, 2, 3, b"frame", 7))
    talk.hear(talk.board.rx(5, 1, 2, 3, b"frame"))
    assert talk.counters == {"unknown-record": 1}
    assert len(talk.events) == 2


def test_transmissions_are_asked_for_by_dx_and_their_end_is_reported_by_tx_ticks():
    talk = Talk().ready()
    tx_ticks = (T0 & ~0x1FF) + DELAYS.tx_ticks
    for number, frame in enumerate((b"one", b"two")):
        talk.session.transmit(Transmission(frame, tx_ticks + 512 * number))
        record = talk.commands[-1]
        assert (record[0], record[link.TX_FRAME_AT :]) == (link.TX_AT, frame)
        assert int.from_bytes(record[2:7], "little") == (T0 & ~0x1FF) + 512 * number
    dx = T0 & ~0x1FF
    talk.hear(talk.board.tx_done(dx, tx_ticks))
    talk.hear(talk.board.tx_done(dx, tx_ticks))  # nobody asked for that one any more
    talk.hear(talk.board.tx_late((T0 & ~0x1FF) + 512, link.LATE_FOR_RADIO))
    assert talk.events[1:] == [Sent(tx_ticks), Late(tx_ticks + 512)]
    assert not +talk.counters
    talk.session.transmit(Transmission(b"three", tx_ticks))
    talk.hear(talk.board.tx_done(dx, tx_ticks + 1))
    assert talk.counters == {"sent-at-another-time": 1}


def test_before_the_board_is_ready_everything_is_late_and_nothing_is_heard():
    talk = Talk()
    talk.hear(talk.board.rx(5, 0, 0, 0, b"frame"))
    talk.session.transmit(Transmission(b"one", 77))
    talk.hello()
    talk.hear(talk.board.rx(5, 0, 0, 0, b"frame"))
    assert talk.events == [Late(77)]


def test_dx_wraps_with_the_counter():
    talk = Talk().ready()
    talk.session.transmit(Transmission(b"x", 100))
    assert int.from_bytes(talk.commands[-1][2:7], "little") == 2**40 + 100 - DELAYS.tx_ticks


def test_lost_copied_unknown_malformed_and_garbled_records_are_counted():
    talk = Talk().ready()
    frame = b"frame"
    talk.hear(talk.board.rx(1, 0, 0, 0, frame))
    line = talk.board.rx(2, 0, 0, 0, frame)
    talk.hear(line + line)
    talk.board.record(link.RX_ON)  # two that never arrive
    talk.board.record(link.RX_ON)
    talk.hear(talk.board.rx(3, 0, 0, 0, frame))
    talk.hear(talk.board.record(0x3F))
    talk.hear(talk.board.rx(3, 0, 0, 0, b""))
    for kind in (link.TX_DONE, link.TX_LATE, link.STATUS, link.REFUSED, link.HELLO):
        talk.hear(talk.board.record(kind))
    talk.hear(b"\x05garbage\0" + line[:10] + b"\0")
    assert [event.rx_ticks for event in talk.events[1:]] == [1, 2, 3]
    several = {"lost-record": 2, "malformed-record": 6, "garbled-record": 2}
    assert talk.counters == {"copied-record": 1, "unknown-record": 1, **several}


def test_records_of_a_later_minor_version_are_read():
    talk = Talk()
    board = talk.board
    rate = link.RATE_KHZ.to_bytes(4, "little")
    talk.hear(board.record(link.HELLO, bytes([link.MAJOR, 9, 1, 2, 3, *range(8), *rate, 40, 0xFF, 2, 3, 4])))
    stamp = T0.to_bytes(5, "little")
    talk.hear(board.record(link.STATUS, bytes([*stamp, ON, *bytes(24), 0, 0x80, 0xFF, 0xFF, 9, 9])))
    assert talk.events == [Restarted()]
    assert talk.session.hello.reset_cause == 2
    assert (talk.session.status.temperature_c, talk.session.status.supply_v) == (None, None)


def test_a_board_of_another_major_version_is_refused_once_and_taken_when_it_has_changed():
    talk = Talk()
    talk.kinds()
    for _ in range(3):
        talk.hear(talk.board.record(link.HELLO, bytes([2, 0])))
        talk.poll(STATUS_S)
    (gone,) = talk.events
    assert gone == Gone(
        "the board at /dev/board has version 2.0 of the serial link, this program 1.4; bring the board's firmware "
        "and Skyless to the same release"
    )
    assert set(talk.kinds()) == {link.ASK_HELLO}
    talk.status()
    assert talk.events == [gone]
    talk.hello()
    talk.status()
    assert talk.events == [gone, Restarted()]


def test_a_board_that_refuses_its_configuration_or_counts_otherwise_cannot_be_used():
    talk = Talk()
    talk.hello()
    talk.hear(talk.board.record(link.REFUSED, bytes((link.CONFIG, link.REFUSED_SETTING))))
    talk.hear(talk.board.record(link.REFUSED, bytes((link.TX_AT, link.REFUSED_MALFORMED))))
    assert [type(event) for event in talk.events] == [Gone]
    assert "refuses its configuration" in talk.events[0].reason
    assert talk.counters == {"refused-command": 1}
    talk = Talk()
    rate = (1000).to_bytes(4, "little")
    talk.hear(talk.board.record(link.HELLO, bytes([link.MAJOR, 0, 1, 2, 3, *range(8), *rate, 32, 1])))
    assert "counts 1000 kHz in 32 bits" in talk.events[0].reason


def test_a_board_whose_radio_does_not_start_is_reported_of_once_and_taken_when_it_does():
    talk = Talk()
    for _ in range(4):
        talk.hello()
        talk.hear(talk.board.record(link.REFUSED, bytes((link.CONFIG, link.REFUSED_RADIO))))
        talk.poll(STATUS_S)
    gone = Gone("the board at /dev/board refuses its configuration: its radio does not answer or start")
    assert talk.events == [gone]
    talk.hello()
    talk.status()
    assert talk.events == [gone, Restarted()]
    talk.hear(talk.board.record(link.REFUSED, bytes((link.CONFIG, link.REFUSED_RADIO))))
    assert talk.events == [gone, Restarted(), gone]


def test_frames_whose_answer_was_lost_on_the_line_are_not_kept_for_ever():
    talk = Talk().ready()
    for number in range(1000):
        talk.session.transmit(Transmission(b"frame", (number << 9) + DELAYS.tx_ticks))
    assert len(talk.session._pending) == MAX_PENDING_FRAMES
    told = len(talk.events)
    talk.hear(talk.board.tx_done(999 << 9, (999 << 9) + DELAYS.tx_ticks))
    assert talk.events[told:] == [Sent((999 << 9) + DELAYS.tx_ticks)]


def test_an_anchor_needs_a_board_that_can_transmit():
    talk = Talk(transmits=True)
    talk.hear(talk.board.hello((1, 2, 3), bytes(8), 0))
    talk.status()
    assert talk.events == [Gone("the board at /dev/board only listens; an anchor needs one that can transmit")]
    talk = Talk(transmits=True)
    talk.hello()
    talk.status()
    assert talk.events == [Restarted()]


def test_a_board_that_starts_again_is_configured_again_and_its_numbers_begin_again():
    talk = Talk().ready()
    tx_ticks = (T0 & ~0x1FF) + DELAYS.tx_ticks
    talk.session.transmit(Transmission(b"one", tx_ticks))
    talk.start_again()
    talk.status(0, 5)
    assert not talk.session.ready
    assert talk.kinds() == [link.TX_AT, link.ASK_STATUS, link.CONFIG, link.RX_ON]
    talk.status(ON, 1000)
    assert talk.events == [Restarted(), Restarted()]
    assert talk.session.clock.read(talk.now_s) == 1000
    talk.hear(talk.board.tx_done(T0 & ~0x1FF, tx_ticks))  # of its former life
    assert talk.events == [Restarted(), Restarted()]
    assert talk.counters == {"board-restart": 1}


def test_a_board_that_starts_again_and_again_is_counted_and_reported_once():
    """It falls over its configuration each time, is never ready, and is never silent."""
    talk = Talk()
    talk.hello()
    for _ in range(6):
        talk.poll(2.0)
        talk.start_again()
        talk.status(0)
    (hint,) = talk.events
    assert isinstance(hint, Hint)
    assert "the board at /dev/board starts again and again (3 times within 4 s, at last by power" in hint.text
    assert talk.counters == {"board-restart": 6}


@pytest.mark.parametrize(
    ("cause", "words"),
    [
        (0, ", at last by power on or too low a supply)"),
        (link.RESET_BY_PIN, ", at last by its reset pin)"),
        (link.RESET_BY_WATCHDOG, ", at last by its watchdog)"),
        (link.RESET_BY_SOFTWARE, ", at last by its firmware)"),
        (link.RESET_BY_LOCKUP, ", at last by a lockup of its processor)"),
        (
            link.RESET_BY_FAULT | link.RESET_BY_SOFTWARE,
            ", at last by a fault that its firmware noticed and its firmware)",
        ),
        (0x40, ", at last by cause 0x40)"),
        (None, "within 4 s):"),
    ],
)
def test_the_report_of_a_board_that_starts_repeatedly_names_the_last_cause(cause, words):
    """None: a board of version 1.0, whose HELLO has no cause."""
    talk = Talk()
    talk.hello()
    rate = link.RATE_KHZ.to_bytes(4, "little")
    body = bytes([link.MAJOR, 0, 1, 2, 3, *range(8), *rate, 40, link.CAN_TRANSMIT])
    for last in (link.RESET_BY_PIN, link.RESET_BY_PIN, cause):
        talk.poll(2.0)
        talk.board = link.Writer()
        talk.hear(talk.board.record(link.HELLO, body if last is None else body + bytes([last])))
        talk.status(0)
    (hint,) = talk.events
    assert words in hint.text
    assert talk.session.hello.reset_cause == cause


def test_an_interrupt_line_that_does_not_follow_is_counted_and_reported_once():
    talk = Talk().ready()
    for state in (ON, ON | link.IS_POLLED, ON | link.IS_POLLED, ON, ON | link.IS_POLLED):
        talk.status(state)
    hints = [event for event in talk.events if isinstance(event, Hint)]
    assert len(hints) == 1
    assert "interrupt line of the radio on the board at /dev/board does not follow its events" in hints[0].text
    assert talk.counters == {"interrupt-line-stuck": 2}
    assert talk.session.ready


def test_a_board_that_answers_and_never_listens_is_reported_once():
    talk = Talk()
    talk.hello()
    for _ in range(30):
        talk.poll(1.0)
        talk.status(link.IS_CONFIGURED)
    assert talk.events == [Hint("the board at /dev/board answers, but does not start to receive: does its radio work?")]
    assert talk.session.hello is not None
    talk.status()
    assert talk.events[1:] == [Restarted()]


def test_a_board_that_works_and_starts_again_now_and_then_is_counted_and_not_reported():
    talk = Talk().ready()
    for _ in range(5):
        talk.is_well(31)
        talk.start_again()
        talk.status(0)
        talk.status()
    assert talk.events == [Restarted()] * 6
    assert talk.counters == {"board-restart": 5}


def test_a_loop_that_comes_back_after_a_calm_time_is_reported_again():
    talk = Talk().ready()
    for calm_s in (0, 90):
        talk.is_well(calm_s)
        for _ in range(4):
            talk.poll(2.0)
            talk.start_again()
            talk.status(0)
            talk.status()
    assert sum(isinstance(event, Hint) for event in talk.events) == 2


def test_receptions_with_errors_that_the_board_reports_are_counted_since_the_first_status():
    talk = Talk().ready()
    for errors in (1, 5, 9, 2):  # the last one after a start
        talk.hear(talk.board.status(T0, ON, [7, errors, 0, 0, 0, 0], 2150, 3300))
    assert talk.counters == {"rx-error": 8}


def test_a_second_answer_to_hello_changes_nothing_and_a_lost_configuration_is_sent_again():
    talk = Talk().ready()
    talk.hello()
    talk.status()
    assert talk.events == [Restarted()]
    talk = Talk()
    talk.hello()
    talk.kinds()
    talk.poll(STATUS_S)
    assert talk.kinds() == [link.CONFIG, link.RX_ON]


@pytest.mark.parametrize(
    ("first", "said"),
    [
        (lambda talk: None, "no board answers at /dev/board"),
        (lambda talk: talk.hear(b"Hello from PANS\r\n" * 9), "no serial link of Skyless (153 bytes); wrong baud rate?"),
        (Talk.ready, "has stopped answering"),
    ],
)
def test_a_board_that_is_silent_is_given_up(first, said):
    talk = Talk()
    first(talk)
    assert talk.poll(BOARD_SILENCE_S) is None
    assert said in talk.poll(1.0)


@pytest.mark.parametrize(("share", "words"), [(0.0, 0), (0.01, 1), (0.1, 10), (0.5, 50), (0.83, 83)])
def test_a_line_that_spoils_records_is_named_once_within_ten_seconds(share, words):
    """In a stream of 150 receptions a second; the share that is named is about the true one."""
    generator, talk = random.Random(7), Talk().ready()
    for number in range(1500):
        if number % 75 == 0:
            talk.poll(STATUS_S)
            talk.status()
        line = bytearray(talk.board.rx(number, -8000, -8100, 0, bytes(100)))
        if generator.random() < share:
            line[generator.randrange(len(line) - 1)] ^= 0x40
        talk.hear(bytes(line))
    hints = " ".join(one.text for one in talk.events if isinstance(one, Hint))
    named = list(map(int, re.findall(r"(\d+) % of what the board", hints)))
    assert len(named) == (share > 0) or named[0] < 10 <= named[1]
    assert not named or abs(named[-1] - words) <= max(5, 0.3 * words)


def test_a_full_line_is_not_called_a_spoilt_one():
    """The board counts a record's number before it finds that there is no room, and says so in its status."""
    talk, unsent = Talk().ready(), 0
    for number in range(1500):
        line = talk.board.rx(number, -8000, -8100, 0, bytes(100))
        if number % 20:
            talk.hear(line)
        else:
            unsent += 1
        if number % 75 == 74:
            talk.poll(STATUS_S)
            talk.hear(talk.board.status(T0, ON, [*COUNTS[:5], COUNTS[5] + unsent]))
    hints = [one.text for one in talk.events if isinstance(one, Hint)]
    assert len(hints) == 1
    assert "is full" in hints[0]
