"""The README's Python runs as it stands."""

import re
from pathlib import Path

README = Path(__file__).parents[1] / "README.md"


def test_the_example_runs(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    exec(compile(example, str(README), "exec"), {})
    x, y, z = map(float, re.search(r"\[ *(\S+) +(\S+) +(\S+) *\]", capsys.readouterr().out).groups())
    assert abs(x - 3.0) < 0.15
    assert abs(y - 4.0) < 0.15
    assert z == 0.0


def test_its_links_lead_somewhere():
    for link in re.findall(r"\]\(([^)#]+)\)", README.read_text(encoding="utf-8")):
        assert (README.parent / link).exists(), link
