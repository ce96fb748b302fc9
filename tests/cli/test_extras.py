"""What a robot installs is enough for a tag; other commands name the extra that they lack, in one line."""

import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from skyless.machine import EXTRA_OF, how_to_install, what_to_install

pytestmark = pytest.mark.site

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
BLOCKED = f"import sys\nsys.modules.update(dict.fromkeys({sorted(EXTRA_OF)!r}))\nfrom skyless.cli.main import main\n"


def distribution(requirement):
    return re.split(r"[^\w-]", requirement)[0].lower()


def test_every_library_of_an_extra_is_named():
    extras = {
        distribution(requirement): extra
        for extra, requirements in PROJECT["optional-dependencies"].items()
        for requirement in requirements
        if extra != "notebook"  # what talks with an editor, not with Skyless
        if not requirement.startswith("skyless[")
    }
    importable = {
        module: name.lower()
        for module, names in packages_distributions().items()
        for name in names
        if name.lower() in extras and not module.startswith("_")
    }
    for name in set(importable.values()):
        assert any(EXTRA_OF.get(module) == extras[name] for module, of in importable.items() if of == name), name
    for module, extra in EXTRA_OF.items():
        assert module not in importable or extras[importable[module]] == extra
    assert set(EXTRA_OF.values()) <= set(PROJECT["optional-dependencies"])


def test_what_to_install_depends_on_who_made_the_environment(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "prefix", str(tmp_path / ".venv"))
    assert how_to_install("pandas") == "pip install '.[pandas]' in a checkout of Skyless adds it"


def test_another_missing_module_is_a_defect():
    assert what_to_install(ImportError("text", name="skyless.nothing")) is None
    assert what_to_install(ImportError("text")) is None


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (["record", "x.mcap", "--mqtt", "mqtt://127.0.0.1:1"], "site"),
        (["dashboard", "--mqtt", "mqtt://127.0.0.1:1"], "page"),
        (["tag", "t1", "--site-key", "none", "--mqtt", "none"], None),
        (["tag", "t1", "--radio", "bluetooth", "--mqtt", "none", "--print"], None),
        (["tag", "--help"], None),
        (["anchor", "--help"], None),
    ],
)
def test_a_command_needs_its_extra_only(arguments, extra):
    code = f"{BLOCKED}sys.exit(main({arguments!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    if extra is None:
        assert "which is not installed" not in done.stderr
    else:
        assert done.returncode == 2
        assert done.stderr.splitlines()[-1].endswith(how_to_install(extra))
    assert "Traceback" not in done.stderr
