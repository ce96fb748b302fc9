"""Every test that ``docs/reported.md`` names exists."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_tests_are_there():
    named = set(re.findall(r"`(test_\w+)`", (ROOT / "docs" / "reported.md").read_text(encoding="utf-8")))
    texts = (file.read_text(encoding="utf-8") for file in (ROOT / "tests").rglob("test_*.py"))
    assert len(named) > 50
    assert named - {name for text in texts for name in re.findall(r"def (test_\w+)", text)} == set()
