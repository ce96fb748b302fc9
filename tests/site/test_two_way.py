from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.research.foreign.datasets import anchor_distances_m
from skyless.site.survey.legs import AnchorFlights, Leg, bracketed_flight_ticks

SECOND = 63_897_600_000
wrapped = st.integers(0, 2**40 - 1)


def legs(flight, rate, offset_x, offset_y, bits, times=(0, SECOND // 50, SECOND // 25)):
    """Exact stamps, rounded to ticks, of x → y, y → x, x → y; clock y runs ``rate`` faster than true time."""

    def y(time):
        return round(time * (1 + rate)) + offset_y

    mask = (1 << bits) - 1
    first, back, last = times
    return (
        Leg((first + offset_x) & mask, y(first + flight) & mask),
        Leg(y(back) & mask, (back + flight + offset_x) & mask),
        Leg((last + offset_x) & mask, y(last + flight) & mask),
    )


@given(st.integers(0, 100_000), st.floats(-40e-6, 40e-6), wrapped, wrapped, st.sampled_from([32, 40]))
def test_exact_stamps_give_the_flight_whatever_the_clocks(flight, rate, offset_x, offset_y, bits):
    times = (0, SECOND // 100, SECOND // 50)
    before, back, after = legs(flight, rate, offset_x, offset_y, bits, times)
    assert bracketed_flight_ticks(before, back, after, bits) == pytest.approx(flight * (1 + rate), abs=1.5)


def test_what_is_no_bracket_or_no_clock_gives_none():
    before, back, after = legs(1000, 0.0, 0, 0, 40)
    assert bracketed_flight_ticks(before, Leg(back.tx_ticks, after.tx_ticks + 1), after, 40) is None
    assert bracketed_flight_ticks(before, back, Leg(after.tx_ticks, after.rx_ticks + SECOND // 1000), 40) is None
    assert bracketed_flight_ticks(before, Leg(back.tx_ticks + 10**6, back.rx_ticks), after, 40) is None


def test_the_median_of_a_pair_survives_wild_stamps_and_a_restart():
    flights = AnchorFlights(1001)
    for number in range(60):
        start = number * SECOND // 10
        shift = 0 if number < 30 else 777_777_777
        if number == 30:
            flights.forget(1)
        for (sender, receiver), leg in zip(
            ((1, 2), (2, 1), (1, 2)), legs(900, 7e-6, start, start + shift, 40), strict=True
        ):
            glitch = 5000 if number % 7 == 3 else 0
            flights.update(sender, receiver, leg.tx_ticks, (leg.rx_ticks + glitch) % 2**40)
    assert flights.ranged_ticks() == {(1, 2): pytest.approx(900, abs=2)}
    assert flights.update(1, 3, 0, 0) is None


def test_the_distances_of_a_commercial_systems_anchors(recordings):
    drops = Counter()
    found = anchor_distances_m(recordings / "nozomi_rtls" / "avalue_first90s" / "ccp.csv", drops)
    names = {tuple(f"{anchor:X}"[-2:] for anchor in pair): metres for pair, metres in found.items()}
    published = {
        ("52", "5A"): 6.88,
        ("52", "5B"): 8.50,
        ("52", "5E"): 5.88,
        ("5A", "5B"): 5.29,
        ("5A", "5E"): 8.97,
        ("5B", "5E"): 7.07,
    }
    assert names == pytest.approx(published, abs=0.05)
    assert not drops
