"""What ``joint`` gives on two recordings and in a simulated room is that of the last deliberate change of results.

The traces are 200 fixes each in ``traces/``, so that a change of the estimator's output is a diff that can be read:

    python tests/research/test_traces.py        writes them again
"""

import os
from pathlib import Path

import numpy as np
import pytest

from skyless import Request, fleet_of, lab_site
from skyless.research.replays.captures import CaptureReplay
from skyless.research.replays.options import ReplayOptions
from skyless.sim.evaluation.scenarios import Room
from skyless.sim.impairments import Body

pytestmark = pytest.mark.site

TRACES = Path(__file__).with_name("traces")
ROWS = 200
RECORDED_S, SIMULATED_S = 30.0, 12.0
HEAD = "time_s,x_m,y_m,z_m,sigma_m,hpl_m"
RECORDINGS = {
    "const4_trial3": ("util_flights/const4/const4-trial3-tdoa2-traj1_tdoa.csv.gz", "util_flights/anchors_const4.csv"),
    "muloc": ("muloc/location1_2.npz", None),
}
SIMULATIONS = {"body": {"body": Body()}}
TOLERANCE_M, LEVEL_TOLERANCE = 5e-3, 0.05
"""Another processor rounds otherwise, and a filter's decisions may then differ for single packets."""


def thinned(fixes, seconds):
    """Evenly spaced rows: time, position, horizontal standard deviation, level."""
    rows, next_s = [], -np.inf
    for time_s, position_m, covariance_m2, hpl_m in fixes:
        if time_s >= next_s:
            next_s = time_s + seconds / ROWS
            sigma_m = float(np.sqrt(covariance_m2[0, 0] + covariance_m2[1, 1]))
            rows.append((time_s, *position_m, sigma_m, np.nan if hpl_m is None else hpl_m))
    return np.round(np.array(rows), 3)


def recorded(name, folder):
    file, anchors = RECORDINGS[name]
    options = ReplayOptions(
        folder / file, anchors=anchors and folder / anchors, uncalibrated=bool(anchors), first_s=RECORDED_S
    )
    fixes = []
    CaptureReplay(options).run(lambda _, time_s, fix: fixes.append(fix), lambda _: None)
    begin_s = fixes[0].time_s
    return thinned(((fix.time_s - begin_s, fix.position_m, fix.covariance_m2, fix.hpl_m) for fix in fixes), RECORDED_S)


def simulated(name):
    fleet = fleet_of(Request(site=lab_site(), seed=3, tags=1, room=Room(), **SIMULATIONS[name]))
    fixes = ((one.time_s, one.fix.position_m, one.fix.covariance_m2, one.fix.hpl_m) for one in fleet.run(SIMULATED_S))
    return thinned(fixes, SIMULATED_S)


def kept(name):
    return np.loadtxt(TRACES / f"{name}.csv", delimiter=",", skiprows=1)


def assert_same(found, name):
    wanted = kept(name)
    assert found.shape == wanted.shape
    np.testing.assert_allclose(found[:, :5], wanted[:, :5], atol=TOLERANCE_M)
    np.testing.assert_allclose(found[:, 5], wanted[:, 5], rtol=LEVEL_TOLERANCE)


@pytest.mark.parametrize("name", RECORDINGS)
def test_recordings(name, recordings):
    if not (recordings / RECORDINGS[name][0]).exists():
        pytest.skip(f"{RECORDINGS[name][0]} is not at {recordings}")
    assert_same(recorded(name, recordings), name)


@pytest.mark.parametrize("name", SIMULATIONS)
def test_simulated_rooms(name):
    assert_same(simulated(name), name)


def main():
    folder = Path(os.environ.get("SKYLESS_DATA", Path(__file__).parents[3] / "shared" / "data"))
    traces = {name: recorded(name, folder) for name in RECORDINGS} | {name: simulated(name) for name in SIMULATIONS}
    for name, rows in traces.items():
        np.savetxt(TRACES / f"{name}.csv", rows, fmt="%.3f", delimiter=",", header=HEAD, comments="")


if __name__ == "__main__":
    main()
