"""The page's modules import each other in no circle, neither as files nor as folders."""

import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import skyless.page

pytestmark = pytest.mark.site

BROWSER = (Path(skyless.page.__file__).parent / "browser").resolve()


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
