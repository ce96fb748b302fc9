"""What the compiler makes of the estimator: no counting of references to arrays, which would take half the time."""

import os
import re
import subprocess
import sys

import pytest

pytestmark = pytest.mark.statistical

SCRIPT = """
from estimator_builders import MESH, begun, episode_of, settings_of
from skyless.core.estimator import estimator
episode = episode_of(MESH, 4)
begun(episode, settings_of(MESH)).track(episode.packets)
print(estimator._process.inspect_llvm(estimator._process.signatures[0]))
"""
"""In a process of its own, as what comes from the cache cannot be looked into."""


def test_no_references_are_counted_in_a_packet(tmp_path):
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=env, capture_output=True, text=True, check=True)
    counts, name = {}, ""
    for line in done.stdout.splitlines():
        start = re.match(r"define .*@(\S+?)\(", line)
        name = start.group(1) if start else name
        counts[name] = counts.get(name, 0) + ("call void @NRT_incref" in line)
    [of_process] = [count for name, count in counts.items() if re.match(r"_ZN7skyless.*8_process", name)]
    assert of_process == 0, "a step of the estimator with arrays returns early, or does not use its state at the end"
