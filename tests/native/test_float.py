"""The library for ``float``, as a Cortex-M4F computes: as good as that for ``double``, on the same packets."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from core_build import EXACT, NATIVE, has

sys.path.insert(0, str(Path(__file__).parents[1] / "core"))

from estimator_builders import LAB_M, ROOM_M, Case, begun, episode_of, nees, rmse, settings_of, tracked

from skyless.core.integrity import HPL
from skyless.sim.evaluation.scenarios import Request, fleet_of
from skyless.sim.lab import paper_lab_site

pytestmark = [pytest.mark.site, pytest.mark.skipif(not has("gcc"), reason="there is no gcc")]

WITH_FLOAT = Path(__file__).with_name("with_float.py")
ERRORS = {"survey_std_m": 0.02, "range_std_m": 0.03, "slope_std_m": 0.05, "place_std_m": 0.005}
WALKING = {"lab": (LAB_M, 0.0, {}), "room": (ROOM_M, 0.0, ERRORS), "3-D": (ROOM_M, None, ERRORS)}
SLOW = Case(qa=0.02)
"""Tags that stay in the room for seconds."""
SUPERFRAMES = 400
AT_REST = 60_000
"""Packets of a tag at rest."""
CORTEX_M4F = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard")


def found():
    """What the library of this process computes, by name."""
    results = {}
    for name, (anchors_m, height_m, errors) in WALKING.items():
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
    results["from power-on"] = np.array([judged.fix.position_m for judged in fleet.run(0.5)])
    return results


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """Results for ``double`` and for ``float``, the latter of a process of its own."""
    file = tmp_path_factory.mktemp("float") / "found.npz"
    subprocess.run([sys.executable, WITH_FLOAT, __file__, file], check=True)
    return found(), np.load(file)


@pytest.mark.parametrize("name", WALKING)
def test_errors_and_what_is_said_of_them_are_the_same(both, name):
    double, single = both
    np.testing.assert_allclose(single[name], double[name], rtol=0.01)


@pytest.mark.parametrize("name", [*WALKING, "at rest"])
def test_levels_are_the_same(both, name):
    """At rest what is known of lasting faults grows without end, and what is not stays as it is."""
    double, single = (one[f"levels {name}"] for one in both)
    np.testing.assert_allclose(single, double, rtol=0.03)


def test_a_receiver_starts_at_the_same_place(both):
    double, single = (one["from power-on"] for one in both)
    np.testing.assert_allclose(single, double, atol=1e-3)


def test_damaged_packets_leave_numbers():
    """What 64 bits hold may be no number in 32."""
    command = [WITH_FLOAT, Path(__file__).with_name("test_damaged_packets.py"), "20000", "1"]
    output = subprocess.run([sys.executable, *command], capture_output=True, text=True, check=True).stdout
    for line in output.splitlines():
        damaged, accepted, *_, wrong = map(int, line.split())
        assert damaged > 5_000
        assert accepted > 300
        assert wrong == 0


@pytest.mark.skipif(not has("arm-none-eabi-gcc"), reason="there is no compiler for it")
def test_a_cortex_m4f_computes_no_double(tmp_path):
    """It calls none of the compiler's functions for what it has no instructions for."""
    made = tmp_path / "core.o"
    flags = (*EXACT, *CORTEX_M4F, "-Os", "-DSKYLESS_FLOAT", "-Wdouble-promotion", "-Werror")
    subprocess.run(["arm-none-eabi-gcc", *flags, "-c", NATIVE / "skyless_core.c", "-o", made], check=True)
    asked = subprocess.run(["arm-none-eabi-nm", "-u", made], capture_output=True, text=True, check=True).stdout.split()
    assert {name for name in asked if name != "U"} <= {
        "__aeabi_l2f", "__aeabi_ldivmod", "memcpy", "memmove", "memset",
    }  # fmt: skip


if __name__ == "__main__":
    np.savez(sys.argv[1], **found())
