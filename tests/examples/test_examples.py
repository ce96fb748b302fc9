"""The examples run as they stand, and print what they say."""

import re
import runpy
from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"


def printed(name, capsys):
    """What an example writes on standard output."""
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_own_radio(capsys):
    x_m, y_m, std_cm = map(float, re.findall(r"[-\d.]+", printed("own_radio.py", capsys)))
    assert abs(x_m - 2.0) < 0.15
    assert abs(y_m - 3.0) < 0.15
    assert 0.0 < std_cm < 10.0
