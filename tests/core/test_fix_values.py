"""A fix keeps the rows that a method wrote, and gives them back as what they are."""

import math
import pickle
import struct

import msgspec
import numpy as np
import pytest

from skyless.core.alert import Alert
from skyless.core.fix import PROTECTED_ROWS, PROTECTION, QUALITY, Fix
from skyless.core.integrity import CONTRADICTED, IntegrityRequirement

ANCHORS_M = np.eye(4, 3)


def fix_of(rows: int, *, known=False, asked=None, state=0.0) -> Fix:
    numbers = [*range(1, 28), 0.4, 0.9, state][: 3 * rows]
    return Fix(1.5, struct.pack(f"{len(numbers)}d", *numbers), (3, 1, 4, 2), ANCHORS_M, "joint", known, 2, asked)


def test_rows_are_position_covariance_quality_velocity_and_its_covariance():
    fix = fix_of(PROTECTION)
    assert fix.position_m.tolist() == [1, 2, 3]
    assert fix.covariance_m2.tolist() == [[4, 5, 6], [7, 8, 9], [10, 11, 12]]
    assert (fix.chi2, fix.residual_rms_m, fix.dof) == (13.0, math.sqrt(14.0), 2)
    assert fix.velocity_mps.tolist() == [16, 17, 18]
    assert fix.velocity_covariance.tolist() == [[19, 20, 21], [22, 23, 24], [25, 26, 27]]
    assert fix.std_m == pytest.approx(math.sqrt(4 + 8 + 12))
    assert (fix.hpl_m, fix.vpl_m, fix.integrity_risk, fix.alert) == (None,) * 4
    without = fix_of(QUALITY + 1)
    assert without.velocity_mps is without.velocity_covariance is None


@pytest.mark.parametrize(
    ("known", "limit_m", "state", "expected"),
    [
        (False, None, 0.0, (0.4, 0.9, Alert.NONE)),
        (True, None, 0.0, (0.4, None, Alert.NONE)),
        (True, 0.3, 0.0, (0.4, None, Alert.LIMIT)),
        (True, 0.3, float(CONTRADICTED), (None, None, Alert.NOT_EXCLUDED)),
    ],
)
def test_levels_answer_what_was_asked(known, limit_m, state, expected):
    fix = fix_of(PROTECTED_ROWS, known=known, asked=IntegrityRequirement(1e-3, limit_m), state=state)
    assert (fix.hpl_m, fix.vpl_m, fix.alert) == expected
    assert fix.integrity_risk == 1e-3


def test_a_fix_is_a_value():
    fix = fix_of(PROTECTED_ROWS, asked=IntegrityRequirement())
    again = pickle.loads(pickle.dumps(fix))
    assert repr(again) == repr(fix)
    assert "position_m=[1.0, 2.0, 3.0]" in repr(fix)
    assert msgspec.structs.replace(again, anchors_m=fix.anchors_m) == fix
    assert msgspec.structs.replace(fix, time_s=2.0) != fix
    with pytest.raises(ValueError, match="read-only"):
        fix.position_m[0] = 0.0
