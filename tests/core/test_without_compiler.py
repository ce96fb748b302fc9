"""The whole simulation, anchors, ether and tags, once compiled and once as plain Python."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from skyless.sim.evaluation.scenarios import Request, fleet_of
from skyless.sim.lab import paper_lab_site

pytestmark = pytest.mark.site


def positions(until_s=0.25):
    """All positions of a tag by three methods, through anchors, ether and receiver."""
    found = {}
    for method in ("literal", "bracketed", "joint"):
        fleet = fleet_of(Request(paper_lab_site(), method=method, positions_m=((3.0, 4.0),)))
        found[method] = [judged.fix.position_m.tolist() for judged in fleet.run(until_s)]
    return found


def test_without_the_compiler_the_whole_simulation_is_the_same_to_rounding():
    """Anchors, ether and tags as plain Python, in a process of their own."""
    script = "import json, test_without_compiler as t; print(json.dumps(t.positions()))"
    plain = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "SKYLESS_UNCOMPILED": "1", "PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        text=True,
        check=True,
    )
    compiled = positions()
    for method, rows in json.loads(plain.stdout).items():
        assert len(rows) > 6
        np.testing.assert_allclose(rows, compiled[method], rtol=0.0, atol=1e-6)
