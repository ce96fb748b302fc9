"""A reception is refused where it is made, if a radio of one's own mixes up what it gives."""

import numpy as np
import pytest

from skyless import Reception


@pytest.mark.parametrize(
    ("frame", "rx_ticks", "words"),
    [("abc", 1, "frame is 'abc'; it should be bytes"), (b"abc", 1.5, "rx_ticks is 1.5; it should be an integer")],
)
def test_what_is_no_frame_or_no_count_is_refused_with_what_is_wanted(frame, rx_ticks, words):
    with pytest.raises(TypeError, match=words):
        Reception(frame, rx_ticks)


def test_integers_of_numpy_are_taken():
    assert Reception(b"abc", np.int64(7)).rx_ticks == 7
