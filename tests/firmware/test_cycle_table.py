"""The table of cycles in docs/hardware.md is what the emulated processor needs for the present firmware."""

import re

import pytest
from emulator.build import FIRMWARE, build
from processor_stage import needs_processor

pytest.importorskip("unicorn")

from emulator.processor.cycle_table import cycle_table

pytestmark = pytest.mark.statistical

PAGE = FIRMWARE.parent / "docs" / "hardware.md"
RENEW = "python benchmarks/firmware.py cycles --write renews docs/hardware.md"


def figures(text):
    """Microseconds by path, as a table states them."""
    return {path: float(most) for path, most in re.findall(r"^\| ([^|]+) \| (\d+) \|", text, re.MULTILINE)}


@pytest.fixture(scope="module")
def measured():
    return figures(cycle_table(build("all")))


@needs_processor
@pytest.mark.statistical
def test_the_page_has_what_is_measured(measured):
    """Another release of the compiler may change a figure a little."""
    page = PAGE.read_text("utf-8").partition("<!-- cycles")[2].partition("<!-- end -->")[0]
    assert figures(page) == {path: pytest.approx(most, rel=0.1, abs=2) for path, most in measured.items()}, RENEW


@needs_processor
def test_a_reception_takes_less_than_the_shortest_slot_leaves(measured):
    without, with_phase = (most for path, most in measured.items() if path.startswith("reception"))
    assert 100 < without < with_phase <= 400
    (latency,) = (most for path, most in measured.items() if "latency" in path)
    assert latency < 400
