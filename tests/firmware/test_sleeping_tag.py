"""A tag that sleeps between its fixes: the firmware's C in a simulated room, from its start on."""

import numpy as np
import pytest
from emulator.build import HAS_HOST_COMPILER
from emulator.site.host_board import HostBoard
from emulator.site.tag_world import TagWorld
from msgspec.structs import replace

from skyless.radio.serial.link import BoardSettings, Reader, decode
from skyless.radio.tag_reports import BoardFix
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.evaluation.scenarios import Request, Room, impairments_of, trajectories_of
from skyless.sim.lab import lab_site

pytestmark = [
    pytest.mark.site,
    pytest.mark.skipif(not HAS_HOST_COMPILER, reason="make and gcc are not installed"),
]

SLEEP_S = 0.4
AWAKE_S = 5.0
"""After a start."""


class SleepingTag:
    """A tag, and its fixes with their errors in m and levels."""

    def __init__(self, predicts):
        request, site = Request(lab_site(), seed=4, room=Room()), lab_site()
        world = world_of(site, trajectories_of(request), replace(impairments_of(request, site), diagnostics=True), 4)
        settings = BoardSettings(mode=1, sleep_ms=int(1000 * SLEEP_S), superframes=2, predicts=predicts)
        self.fixes, self._reader, self.now_s = [], Reader(), 0.0
        self.tag = TagWorld(world, HostBoard, self._said, settings, 1.0)
        self.chip = self.tag.chip

    def _said(self, now_s, data):
        for record in self._reader.read(data):
            found = decode(record)
            if isinstance(found, BoardFix):
                error_m = np.linalg.norm((found.fix.position_m - self.tag.truth_m)[:2])
                self.fixes.append((now_s, error_m, np.inf if found.fix.hpl_m is None else found.fix.hpl_m))

    def run(self, seconds):
        """What these seconds add: fixes, seconds on, seconds asleep."""
        before = len(self.fixes), self.chip.receiving_s, self.chip.asleep_s
        self.now_s += seconds
        self.tag.run(self.now_s)
        return self.fixes[before[0] :], self.chip.receiving_s - before[1], self.chip.asleep_s - before[2]


@pytest.mark.parametrize("predicts", [0, 1])
def test_a_tag_that_has_started_is_awake_and_then_sleeps_between_fixes(predicts):
    one = SleepingTag(predicts)
    fixes, _, asleep_s = one.run(AWAKE_S)
    assert (len(fixes) > 1, asleep_s) == (True, 0.0)
    one.run(2 * SLEEP_S)
    fixes, receiving_s, asleep_s = one.run(12 * SLEEP_S)
    times_s, errors_m, levels_m = np.array(fixes).T
    assert 6 <= len(fixes) <= 12
    assert np.diff(times_s).min() > SLEEP_S
    assert errors_m.max() < 0.5
    assert np.all(errors_m < levels_m)
    assert asleep_s > 0.6 * 12 * SLEEP_S
    assert receiving_s / len(fixes) < (0.02 if predicts else 0.2)
    assert not +one.chip.misuse
