"""A whole site on the firmware in virtual time: its C compiled for this computer, and the ARM image emulated.

The programs are those of ``skyless anchor`` and ``skyless tag``, behind pseudo-terminals.
"""

import pytest
from site_stage import KINDS, site_of

pytestmark = pytest.mark.statistical

SECONDS = {"host": 2.0, "image": 1.2}
WARMUP_S = 0.6


@pytest.fixture(scope="module", params=KINDS)
def ran(request):
    """Six anchors and a tag that walks, in slots of 2.1 ms."""
    site = site_of(request.param, 2.1)
    site.run(SECONDS[request.param])
    return site


def test_frames_are_sent_in_time_and_receptions_are_reported_with_the_right_stamps(ran):
    result = ran.result(WARMUP_S)
    assert result.slots > 250
    assert result.sent >= 0.995 * result.slots
    assert result.reported >= 0.99 * result.at_antennas
    assert result.wrong == 0
    assert not result.misused
    for node in ran.nodes:
        assert not +node.radio.counters
        assert set(node.chip.arrivals) == {"heard"}


def test_the_tag_is_where_the_fixes_are(ran):
    assert len(ran.fixes["tag1"]) > 250
    assert ran.result(WARMUP_S).rms_m < 0.05


@pytest.mark.parametrize("kind", KINDS[:1])
def test_a_seed_gives_the_same_run_each_time(kind):
    runs = []
    for _ in range(2):
        site = site_of(kind, 2.1, seed=3)
        site.run(0.4)
        log = sorted(site.log)  # of lines of one instant, the kernel's pseudo-terminals decide which comes first
        runs.append((site.sent, site.fixes["tag1"], [node.radio.heard for node in site.nodes], log))
    assert len(runs[0][0]) > 50
    assert runs[0] == runs[1]
