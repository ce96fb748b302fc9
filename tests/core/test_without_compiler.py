"""The estimator alone and the whole simulation, anchors, ether and tags, once compiled and once as plain Python."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from estimator_builders import BIASED, MESH, begun, episode_of, late, one_by_one, settings_of

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


def motions_of_an_episode():
    """What an estimator says after each packet."""
    episode = episode_of(MESH, 10)
    estimator, motions = begun(episode, settings_of(MESH, **BIASED)), []
    for packet in one_by_one(late(episode.packets, np.where(np.arange(60) == 40, 0.6, 0.0))):
        estimator.process(*packet)
        motions.append(estimator.motion()[0].tolist())
    return motions


def test_without_the_compiler_all_is_the_same_to_rounding():
    """As plain Python, in a process of its own."""
    script = "import json, test_without_compiler as t; print(json.dumps([t.positions(), t.motions_of_an_episode()]))"
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    env = {**os.environ, "SKYLESS_UNCOMPILED": "1", "PYTHONPATH": path}
    plain = subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, check=True)
    compiled = positions()
    plain_positions, motions = json.loads(plain.stdout)
    for method, rows in plain_positions.items():
        assert len(rows) > 6
        np.testing.assert_allclose(rows, compiled[method], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(motions, motions_of_an_episode(), rtol=0.0, atol=1e-8)
