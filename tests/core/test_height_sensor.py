"""A tag with a sensor of its height, among anchors in one plane that do not tell it."""

import numpy as np
import pytest

from skyless.core.alert import Alert
from skyless.core.any_receiver import AnyReceiver
from skyless.core.fix import Fix
from support.bench import LAB, LOFT, tape

pytestmark = pytest.mark.site

STD_M = 0.03


def heard_with_heights(position, height_of, seconds=6.0):
    """The last fixes of a tag whose sensor speaks after every packet, and whether what it said was used."""
    receiver, fixes, used = AnyReceiver(), [], []
    for one in tape(LOFT, seconds, position=position):
        fix = receiver.hear(one.reception)
        if isinstance(fix, Fix):
            fixes.append(fix)
        used.append(receiver.hear_height(height_of(one), STD_M))
    return fixes, used


@pytest.mark.parametrize("z_m", [5.0, 7.0, 3.0], ids=["in the plane", "above", "below"])
@pytest.mark.statistical
def test_the_sensor_tells_the_height_and_which_side_it_is(z_m):
    random = np.random.default_rng(1)
    fixes, used = heard_with_heights((3.0, 4.0, z_m), lambda one: one.truth_m[2] + random.normal(0.0, STD_M))
    assert sum(used) > 0.99 * len(fixes)
    for fix in fixes[-200:]:
        assert np.linalg.norm(fix.position_m - (3.0, 4.0, z_m)) < 6.0 * fix.std_m
        assert fix.alert == Alert.NONE
        assert abs(fix.position_m[2] - z_m) < fix.vpl_m < 0.5


def test_single_wild_heights_are_left_out():
    random = np.random.default_rng(1)

    def wild(one):
        return one.truth_m[2] + random.normal(0.0, STD_M) + (3.0 if random.random() < 0.1 else 0.0)

    fixes, used = heard_with_heights((3.0, 4.0, 5.0), wild)
    assert 0.85 < sum(used) / len(fixes) < 0.95
    assert all(abs(fix.position_m[2] - 5.0) < 0.1 for fix in fixes[-200:])


def test_a_sensor_that_never_fits_leads_to_a_new_start():
    """The side of the plane was wrong, as the owner had said that it could only be the lower one."""
    receiver, places = AnyReceiver(z_bounds_m=(0.0, 5.0)), []
    for k, one in enumerate(tape(LOFT, 6.0, position=(3.0, 4.0, 6.5))):
        fix = receiver.hear(one.reception)
        if isinstance(fix, Fix):
            places.append(fix.position_m[2])
        if k == 1000:
            assert places[-1] < 5.1
        if k > 1000:
            receiver.hear_height(6.5, STD_M)
    assert abs(places[-1] - 6.5) < 0.1


@pytest.mark.parametrize(("height_m", "std_m"), [(np.nan, 1.0), (1.0, 0.0), (1.0, np.inf), (1.0, -1.0)])
def test_what_is_no_height_is_refused(height_m, std_m):
    with pytest.raises(ValueError, match="height"):
        AnyReceiver().hear_height(height_m, std_m)


def test_a_method_without_states_has_no_use_for_it():
    receiver = AnyReceiver("literal")
    assert not receiver.hear_height(1.0, 0.1)
    for one in tape(LAB, 1.0):
        receiver.hear(one.reception)
    assert not receiver.hear_height(0.0, 0.1)
