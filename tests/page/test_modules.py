"""The page's modules: they import each other in no circle, and node's test runner finds no fault in ``modules/``."""

import importlib.util
import re
import shutil
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import skyless.page

pytestmark = pytest.mark.site

BROWSER = (Path(skyless.page.__file__).parent / "browser").resolve()
MODULES = Path(__file__).with_name("modules")


def test_the_pages_modules_import_each_other_in_no_circle():
    files, folders = {}, {}
    for path in BROWSER.rglob("*.js"):
        if "vendor" in path.parts:
            continue
        found = re.findall(r'^import (?:[^"]* from )?"(\..*)";', path.read_text(encoding="utf-8"), re.MULTILINE)
        others = {(path.parent / name).resolve() for name in found}
        assert all(other.is_file() for other in others), path
        files[path] = others
        group, *groups = (file if file.parent == BROWSER else file.parent for file in (path, *others))
        folders.setdefault(group, set()).update(other for other in groups if other != group)
    assert any(files.values())
    TopologicalSorter(files).prepare()  # raises CycleError, which names the circle
    TopologicalSorter(folders).prepare()


def find_node():
    """The system's node, or Playwright's, of 20.19 or later, which takes the page's files for modules; or None."""
    spec = importlib.util.find_spec("playwright")
    bundled = Path(spec.origin).parent / "driver" / "node" if spec else None
    for node in filter(None, (shutil.which("node"), bundled)):
        said = subprocess.run([node, "--version"], capture_output=True, text=True, check=True).stdout
        if tuple(int(part) for part in said[1:].split(".")[:2]) >= (20, 19):
            return node
    return None


def test_the_pages_modules_do_in_node_what_their_tests_ask_for():
    if (node := find_node()) is None:
        pytest.skip("no node of 20.19 or later: apt install nodejs")
    command = [node, "--disable-warning=MODULE_TYPELESS_PACKAGE_JSON", "--test", *sorted(MODULES.glob("*.test.mjs"))]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=MODULES)
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(re.search(r"pass (\d+)$", done.stdout, re.MULTILINE)[1]) > 0


def test_the_recorded_feed_has_the_shape_of_what_the_server_sends():
    """Figures may differ: they are the estimator's."""
    sys.path.insert(0, str(MODULES))
    import record_feed

    def shape(lines):
        return [re.sub(r"-?\b\d[\d.]*(e[+-]?\d+)?", "0", line) for line in lines.splitlines()[1:]]

    known, now = record_feed.FEED.read_text("utf-8"), record_feed.feed()
    assert known.splitlines()[0] == now.splitlines()[0]
    assert shape(known) == shape(now), "run tests/page/modules/record_feed.py"
