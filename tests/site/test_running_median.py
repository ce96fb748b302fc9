from statistics import median_high

from hypothesis import given
from hypothesis import strategies as st

from skyless.site.survey.legs import RunningMedian


@given(st.lists(st.integers(-5, 5) | st.floats(-1e6, 1e6), min_size=1, max_size=60), st.integers(1, 12))
def test_the_median_of_the_latest_values(values, window):
    running = RunningMedian(window)
    assert running.value is None
    for number, value in enumerate(values, start=1):
        latest = values[max(0, number - window) : number]
        assert running.add(value) == median_high(latest) == running.value
