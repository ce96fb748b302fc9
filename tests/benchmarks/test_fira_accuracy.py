"""The emulated FiRa tag beside the plan: within a tenth, where initiator and responders relay each other."""

import fira_accuracy


def test_a_tag_on_an_emulated_board_errs_as_planned():
    found = fira_accuracy.measure(fira_accuracy.ROUNDS["both ways"], worlds=4, seed=1, version=2)
    assert found.fixes > 10_000
    assert 0.9 < found.ratio < 1.1
