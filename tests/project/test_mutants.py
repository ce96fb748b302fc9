"""The tests of the modules that decide find nearly all of their mutants (``scripts/mutate``)."""

import os
import subprocess
import sys

import pytest

import mutate


@pytest.mark.statistical
@pytest.mark.parametrize("module", mutate.table())
def test_a_module_that_changed_since_it_was_measured_is_measured(module):
    if mutate.measured().get(module) == mutate.digest_of(module, mutate.table()[module]):
        return
    command = [sys.executable, mutate.__file__, module, "--only-say"]
    done = subprocess.run(
        command, check=False, env={**os.environ, "SKYLESS_UNCOMPILED": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
