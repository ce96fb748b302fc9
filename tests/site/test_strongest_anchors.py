"""Which anchors a prediction counts where there are more than a tag uses."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.site import WallSite
from skyless.site.channel import ChannelModel, barriers_of
from skyless.site.planning.links import Scene, link_budget

POINT = np.array([2.0, 3.0, 1.0])


def scene(anchors_m, walls=()):
    return Scene(anchors_m, np.ones(len(anchors_m)), link_budget(ChannelModel()), barriers_of(walls))


@given(st.integers(1, 40), st.integers(1, 24), st.integers(0, 2**32 - 1))
def test_in_the_open_they_are_the_nearest_in_the_order_of_the_file(count, most, seed):
    anchors_m = np.random.default_rng(seed).uniform(-20.0, 20.0, (count, 3))
    rows = np.flatnonzero(np.arange(count) % 3 != 1)
    chosen = scene(anchors_m).strongest(POINT, rows, most)
    assert len(chosen) == min(most, len(rows))
    assert chosen.tolist() == sorted(set(chosen.tolist()) & set(rows.tolist()))
    distances_m = np.linalg.norm(anchors_m - POINT, axis=1)
    left_out = np.setdiff1d(rows, chosen)
    assert not len(left_out) or distances_m[chosen].max() <= distances_m[left_out].min()


def test_an_anchor_behind_a_wall_counts_as_farther():
    """Twice the distance is 6 dB; a wall of 7 dB is more."""
    anchors_m = POINT + np.array([[4.0, 0.0, 0.0], [-7.9, 0.0, 0.0]])
    wall = WallSite(x1_m=4.0, y1_m=0.0, x2_m=4.0, y2_m=6.0, loss_db=7.0, delay_m=0.1)
    rows = np.arange(2)
    assert scene(anchors_m).strongest(POINT, rows, 1).tolist() == [0]
    assert scene(anchors_m, (wall,)).strongest(POINT, rows, 1).tolist() == [1]
