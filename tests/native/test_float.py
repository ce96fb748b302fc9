"""The library for ``float``, as a Cortex-M4F computes: as good as that for ``double``, on the same packets."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from core_build import SITES, needs
from estimator_builders import LAB_M, Case, begun, episode_of, nees, rmse, settings_of, tracked

from skyless.core.integrity import HPL
from skyless.sim.evaluation.scenarios import Request, fleet_of
from skyless.sim.lab import paper_lab_site

pytestmark = [pytest.mark.statistical, needs("gcc")]

WITH_FLOAT = [sys.executable, Path(__file__).with_name("with_sizes.py"), "float"]
SLOW = Case(qa=0.02)
"""Tags that stay in the room for seconds."""
SUPERFRAMES = 400
AT_REST = 60_000
"""Packets of a tag at rest: what is known of lasting faults grows without end, and what is not stays as it is."""


def found():
    """What the library of this process computes, by name."""
    results = {}
    for name, (anchors_m, height_m, errors) in SITES.items():
        episode = episode_of(SLOW, SUPERFRAMES, 1, anchors_m)
        run = tracked(begun(episode, settings_of(SLOW, height_m, **errors), anchors_m), episode.packets)
        warm = slice(len(anchors_m) * 20, None)
        error, covariance = run.errors(episode)[warm], run.covariances[warm]
        results[name] = np.array([rmse(error), nees(error, covariance), (run.outcomes == 1).sum()])
        results[f"levels {name}"] = run.levels[warm, HPL]
    path_m = np.broadcast_to(LAB_M.mean(axis=0) * [1.0, 1.0, 0.0], (AT_REST, 3))
    episode = episode_of(SLOW, AT_REST // len(LAB_M), 1, path_m=path_m)
    run = tracked(begun(episode, settings_of(SLOW)), episode.packets)
    results["levels at rest"] = run.levels[AT_REST // 10 :, HPL]
    fleet = fleet_of(Request(paper_lab_site(), method="joint", positions_m=((3.0, 4.0),)))
    results["start"] = np.array([judged.fix.position_m for judged in fleet.run(0.5)])
    return results


def test_errors_levels_and_starts_are_those_of_double_precision(tmp_path):
    subprocess.run([*WITH_FLOAT, __file__, tmp_path / "found.npz"], check=True)
    double, single = found(), np.load(tmp_path / "found.npz")
    for name, expected in double.items():
        limits = {"atol": 1e-3} if name == "start" else {"rtol": 0.03 if name.startswith("levels") else 0.01}
        np.testing.assert_allclose(single[name], expected, **limits, err_msg=name)


def test_damaged_packets_leave_numbers():
    """What 64 bits hold may be no number in 32."""
    script = Path(__file__).with_name("test_damaged_packets.py")
    done = subprocess.run([*WITH_FLOAT, "pytest", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]


if __name__ == "__main__":
    np.savez(sys.argv[1], **found())
