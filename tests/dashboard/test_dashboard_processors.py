"""The use of processors as Linux counts it."""

import pytest

from skyless.dashboard.processors import USE_WINDOW_S, ProcessorUse


def write(counters, *, busy, idle):
    user, system, wait = busy // 2, busy - busy // 2, idle // 4
    counters.write_text(f"cpu  {user} 0 {system} {idle - wait} {wait} 0 0 0 7 7\ncpu0 1 2 3\n", encoding="ascii")


def test_the_share_is_of_the_last_two_seconds(tmp_path):
    counters = tmp_path / "stat"
    use = ProcessorUse(counters)
    busy, idle, shares = 1000, 5000, []
    for step in range(17):
        write(counters, busy=busy, idle=idle)
        shares.append(use.share(0.5 * step))
        worked = 100 if step >= 8 else 40  # of the 100 ticks of two processors in half a second
        busy, idle = busy + worked, idle + 100 - worked
    assert shares[:4] == [None] * 4
    assert shares[4:9] == pytest.approx([0.4] * 5)
    assert shares[9:12] == pytest.approx([0.55, 0.7, 0.85])
    assert shares[12:] == pytest.approx([1.0] * 5)


@pytest.mark.parametrize("text", ["", "cpu 1 2\n", "cpu a b c d e f g h\n", None])
def test_a_system_that_does_not_say_gives_no_share(tmp_path, text):
    counters = tmp_path / "stat"
    if text is not None:
        counters.write_text(text, encoding="ascii")
    use = ProcessorUse(counters)
    assert [use.share(k * USE_WINDOW_S) for k in range(3)] == [None] * 3


def test_counters_that_stand_still_give_no_share(tmp_path):
    write(tmp_path / "stat", busy=10, idle=10)
    use = ProcessorUse(tmp_path / "stat")
    assert [use.share(k * USE_WINDOW_S) for k in range(3)] == [None] * 3
