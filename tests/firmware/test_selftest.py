"""The self-test: each planted fault is named by its sentence and no other, and boards without one pass."""

import re

import msgspec
import numpy as np
import pytest
from firmware_stage import STACK_BYTES, needs_compiler, needs_processor
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from selftest_stage import FACTS, FEW, Fault, Pair, sentences

from skyless.run.selftest.facts import Report, judge
from skyless.sim.dw1000.chip import Sensors

pytestmark = [pytest.mark.site, needs_compiler]


def facts(**other):
    return tuple(other.get(f"fact{at}", fact) for at, fact in enumerate(FACTS))


ALONE = {
    "line": (Fault(carries=460_800, baud=1_000_000), r"This port carries 460,800 baud, not 1,000,000\."),
    "every rate": (Fault(carries=0), r"This port spoils records at every rate, [\d.]+ % at 460,800 baud\."),
    "part": (Fault(facts=facts(fact0=0x52840)), r"This processor is a 52840, not an nRF52832\."),
    "revision": (Fault(facts=facts(fact2=0x80)), r"Unknown revision 8: please report\."),
    "UICR": (
        Fault(facts=facts(fact2=0x70, fact4=0xFFFFFFFF)),
        r"UICR was not flashed: .*",
    ),
    "stack": (Fault(facts=facts(fact6=10_500)), r"The stack was used to 85 %\."),
    "watchdog": (Fault(cause=2), r"Its firmware failed, and started again \(cause 0x02\)\."),
    "no slow crystal": (Fault(slow_hz=0.0), r"The slow crystal does not run; sleeping tags will be off\."),
    "RC instead of it": (Fault(slow_hz=33_400.0), r"The slow crystal does not run; sleeping tags will be off\."),
    "no chip": (Fault(chip="absent"), r"Read FFFFFFFF 40 times: the chip has no supply or is not selected\."),
    "SPI": (Fault(chip="spi"), r"(\d+ of 40 readings of .* differ|.* not at 8): the SPI is disturbed\."),
    "no lock": (Fault(chip="no lock"), r"The DW1000 answers, but its clock does not lock: supply\."),
    "trim": (Fault(sensors=Sensors(crystal_trim=0)), r"The crystal was never trimmed: offsets up to 20 ppm\."),
    "untested": (Fault(sensors=Sensors(part=0)), r"The chip's memory holds no part number: it was never tested\."),
    "counter": (Fault(processor_ppm=105.0), r"The DW1000's crystal and the processor's differ by -\d+ ppm\."),
    "hot": (Fault(sensors=Sensors(temperature_c=72.0)), r"The chip is at (6[6-9]|7\d) °C\."),
    "supply": (Fault(sensors=Sensors(supply_v=2.75)), r"The supply is 2\.[6-8]\d V, not 3\.3\."),
    "stamp": (Fault(chip="stamp"), r"Frame \d+ left 512 ticks late( \(\d+ frames left at another time\))?\."),
}
"""By what is wrong with one board; its sentence."""

TOGETHER = {
    "slips": (Fault(chip="slips"), r"The clock slips \(\d+ times, the carrier's 0\): supply\."),
    "cycles": (Fault(transfer_s=30e-6), r"The table of cycles is wrong by [3-6]\d %: please report\."),
    "lost": (Fault(lost=0.2), r"B loses \d+ % of A's frames\."),
    "deaf": (Fault(lost=1.0), r"B does not hear A\."),
    "antenna": (Fault(weaker_db=8.0), r"B hears A 8 dB weaker than A hears B: antenna covered\?"),
    "carriers": (Fault(offset_bias_ppm=3.0), r"The boards state offsets of .* ppm, not opposite ones\."),
    "far crystals": (Fault(crystals_ppm=14.0), r"The crystals differ by 28 ppm\."),
    "jitter": (Fault(stamp_ps=320.0), r"Stamps jitter by [3-6]\d\d ps: first path not found, metal near\?"),
    "delays": (Fault(delay_ticks=470), r"Delays off by 4\.\d m: calibrate\."),
}
"""The same of what two boards show."""

CASES = [
    pytest.param(fault, boards, sentence, id=name)
    for table, boards in ((ALONE, 1), (TOGETHER, 2))
    for name, (fault, sentence) in table.items()
]
SEEDS = [1, *(pytest.param(seed, marks=pytest.mark.statistical) for seed in range(2, 21))]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("fault", "boards", "sentence"), CASES)
def test_each_fault_is_named_by_its_sentence_and_no_other(fault, boards, sentence, seed):
    found = sentences(Pair(fault, seed, boards).test())
    assert len(found) == 1, found
    assert re.fullmatch(sentence, found[0]), found


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.statistical) for seed in range(2, 51))])
def test_boards_without_a_fault_pass(seed):
    pair = Pair(seed=seed)
    report = pair.test()
    assert sentences(report) == []
    assert [node.chip.misuse for node in pair.nodes] == [{}, {}]
    assert {check.result for check in judge(report)} == {"ok"}
    assert len(judge(report)) == 28


@pytest.mark.parametrize("baud", [115_200, 1_000_000])
def test_a_tag_that_sleeps_passes_at_its_own_rate_and_has_its_settings_again(baud):
    pair = Pair(Fault(baud=baud, tag=True))
    assert sentences(pair.test(replace(FEW, records=40))) == []
    assert pair.nodes[0].board.baud == baud


def test_a_pair_whose_boards_need_other_rates_than_their_own_keeps_them_until_the_end():
    found = sentences(Pair(Fault(carries=460_800, baud=1_000_000), other=Fault(carries=230_400)).test())
    assert len(found) == 2
    assert all("This port carries" in one for one in found)


def test_a_board_that_falls_silent_while_frames_are_sent_is_named_and_not_the_other():
    pair = Pair()
    receive = pair.nodes[1].chip.receive

    def silence(*words, **more):
        receive(*words, **more)
        pair.nodes[1].wire.noise_to_host = lambda data: b""

    pair.nodes[1].chip.receive = silence
    report = pair.test()
    assert [bool(board.trouble) for board in report.boards] == [False, True]
    assert "ok" not in {check.result for check in judge(report) if check.name in ("board B", "pair")}


@needs_processor
@pytest.mark.statistical
def test_the_image_on_emulated_processors_passes():
    """Its own facts: part, revision, UICR, stack, both crystals, and the time of a reception."""
    pair = Pair(image=True)
    report = pair.test(replace(FEW, records=4, pair_s=1.0))
    assert sentences(report) == []
    for board, node in zip(report.boards, pair.nodes, strict=True):
        assert board.processor[:4] == (0x52832, 0x41414530, 0x50, 21)
        assert board.processor[5] == STACK_BYTES > board.processor[6] > 300
        assert not node.board.misuse


@pytest.fixture(scope="module")
def report():
    return Pair().test(replace(FEW, records=4, pair_s=0.5))


@given(st.data())
def test_a_report_that_was_damaged_is_judged_or_refused(report, data):
    """By values that are gone, or are others: never an exception of another kind."""
    tree = msgspec.to_builtins(report)
    board = tree["boards"][data.draw(st.integers(0, 1))]
    for name in data.draw(st.lists(st.sampled_from(sorted(board)), max_size=4)):
        kept = board.get(name)
        others = [0, -1, 1 << 60, "", None, [], {}] + ([kept[:1]] if isinstance(kept, list | tuple) else [])
        board[name] = data.draw(st.sampled_from(others))
    try:
        damaged = msgspec.convert(tree, Report, str_keys=True)
    except msgspec.ValidationError:
        return
    with np.errstate(all="ignore"):
        assert {check.result for check in judge(damaged)} <= {"ok", "failed", "warning", "not checked"}
