"""On which side of its anchors a tag is, where they stand nearly in one line or plane: then there is no level."""

import numpy as np
import pytest
from estimator_builders import LAB_M, MESH, ROOM_M, begun, episode_of, settings_of, tracked
from pseudoranges import located

from skyless.core.estimator.levels import is_side_open
from skyless.core.fix import NoFixReason
from skyless.core.integrity import SOUND, UNAVAILABLE
from skyless.core.native.views import view
from skyless.core.tag.position import NoSolution

ERRORS = {"survey_std_m": 0.02, "range_std_m": 0.03}


def state_of(anchors_m, height_m=0.0):
    """Of an estimator that has all these anchors."""
    episode = episode_of(MESH, 3, anchors_m=anchors_m)
    return tracked(begun(episode, settings_of(MESH, height_m, **ERRORS), anchors_m), episode.packets).estimator.state


def is_open_at(state, place_m):
    view(state.x)[: len(place_m)] = place_m
    return is_side_open(state)


def in_a_row(draw, off_m, count=6):
    """Anchors along 10 m in any direction, at most ``off_m`` off it and at any height; and the two directions."""
    turn = draw.uniform(0.0, np.pi)
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    x, y = np.linspace(0.0, 10.0, count), draw.uniform(-off_m, off_m, count)
    return np.column_stack([x[:, None] * along + y[:, None] * across, draw.uniform(0.0, 3.0, count)]), along, across


@pytest.mark.parametrize("seed", range(12))
def test_anchors_nearly_in_a_line_leave_the_side_open(seed):
    draw = np.random.default_rng(seed)
    anchors_m, along, across = in_a_row(draw, 0.05)
    state = state_of(anchors_m, height_m=1.0)
    for _ in range(20):
        place_m = draw.uniform(0.0, 10.0) * along + draw.uniform(-6.0, 6.0) * across
        assert is_open_at(state, place_m)


@pytest.mark.parametrize("chosen", [range(6), (0, 2, 3, 5), (0, 2, 4)])
def test_anchors_around_a_room_leave_no_side_open(chosen):
    """Inside of them and up to 2 m outside."""
    state, draw = state_of(LAB_M[list(chosen)]), np.random.default_rng(1)
    low_m, high_m = LAB_M[:, :2].min(axis=0) - 2.0, LAB_M[:, :2].max(axis=0) + 2.0
    assert not any(is_open_at(state, draw.uniform(low_m, high_m)) for _ in range(200))


def test_in_3d_it_is_the_side_of_their_plane():
    flat_m, draw = ROOM_M * (1.0, 1.0, 0.03) + (0.0, 0.0, 2.0), np.random.default_rng(2)
    flat, high = state_of(flat_m, height_m=None), state_of(ROOM_M, height_m=None)
    for _ in range(50):
        place_m = draw.uniform((0.5, 0.5, 0.0), (7.5, 5.5, 3.0))
        assert is_open_at(flat, place_m)
        assert not is_open_at(high, place_m)


def test_the_best_position_on_the_other_side_counts_not_the_image_itself():
    """Anchors on an arc: ranges from the image differ by more than their errors, those from 2 m beside it do not."""
    x = np.linspace(0.0, 10.0, 6)
    anchors_m = np.column_stack([x, 0.5 * ((x - 5.0) / 5.0) ** 2, np.zeros(6)])
    assert is_open_at(state_of(anchors_m), np.array([5.0, 3.0]))
    zigzag_m = np.column_stack([x, 0.5 * (np.arange(6) % 2), np.zeros(6)])
    assert not is_open_at(state_of(zigzag_m), np.array([5.0, 3.0]))


@pytest.mark.site
def test_there_is_no_level_on_an_open_side():
    for anchors_m, state in ((LAB_M, SOUND), (LAB_M * (1.0, 0.01, 1.0), UNAVAILABLE)):
        path_m = np.tile((3.0, 2.5, 0.0), (600, 1))
        episode = episode_of(MESH, 100, anchors_m=anchors_m, path_m=path_m)
        run = tracked(begun(episode, settings_of(MESH, **ERRORS), anchors_m, std_m=0.1), episode.packets)
        assert run.integrity[-1] == state


@pytest.mark.parametrize("seed", range(20))
def test_no_start_takes_the_wrong_side_of_a_row_of_anchors(seed):
    """With range errors, which make the image the better one about as often; a start waits until it is not."""
    draw = np.random.default_rng(seed)
    anchors_m, along, across = in_a_row(draw, 0.1)
    place_m = 5.0 * along + 3.0 * across
    ranges_m = np.hypot(np.linalg.norm(place_m - anchors_m[:, :2], axis=1), 1.0 - anchors_m[:, 2])
    late_m = draw.uniform(-0.05, 0.05, 6)
    reasons = set()
    for _ in range(40):
        heard_m = ranges_m + late_m + draw.normal(0.0, 0.045, 6)
        found = located(anchors_m, heard_m, np.full(6, 0.045**2 + 0.03**2 + 0.02**2), height_m=1.0)
        if isinstance(found, NoSolution):
            reasons.add(found.reason)
        else:
            assert np.linalg.norm(found.position_m[:2] - place_m) < 1.5
    assert reasons <= {NoFixReason.MIRROR, NoFixReason.RESIDUALS}
