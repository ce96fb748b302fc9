"""The emulated FiRa tag next to the plan: within a tenth, where initiator and responders relay each other.

Ten worlds are few; ``benchmarks/fira_accuracy.py`` takes more and several seeds.
"""

import pytest

from support import fira_site

pytestmark = pytest.mark.statistical


def test_a_tag_on_an_emulated_board_errs_as_planned():
    found = fira_site.measure(fira_site.ROUNDS["both ways"], worlds=10, seed=1, version=2, until_s=2.5)
    assert found.fixes > 6_000
    assert 0.9 < found.round_ratio < 1.1
    assert found.ratio < 1.15  # half of the anchors' frames belong to no round; of three times 20 worlds 1.07
