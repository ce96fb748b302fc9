"""Imports run downwards only: each package imports packages of lower layers, and no circle joins files or folders.

The layers are those of ``docs/architecture.md``. A name in quotes is a folder or a module of ``src/skyless``.
"""

import ast
import re
from pathlib import Path

import pytest

import skyless

SOURCE = Path(skyless.__file__).parent

LAYERS = (
    {"constants", "errors", "method_names", "whole_files", "kernels"},
    {"arguments", "rate_limit", "ticks"},
    {"air", "uncertainty"},
    {"site", "authentication"},
    {"clocks", "radios.interface"},
    {"positioning"},
    {"master_election", "slot_claims", "survey"},
    {"anchor", "anchors", "receiver", "receiver_state", "trusted_receiver", "mqtt"},
    {"foxglove"},
    {"simulation", "recordings", "zones"},
    {"radios"},
    {"evaluation"},
    {"replays"},
    {"preparation", "bridges"},
    {"nodes", "paper", "planning", "exports"},
    {"studies"},
    {"survey_inputs", "bench", "dashboard"},
    {"api"},
    {"cli"},
)
LAYER_OF = {name: number for number, names in enumerate(LAYERS) for name in names}
MODULES = {
    ".".join(path.relative_to(SOURCE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in SOURCE.rglob("*.py")
    if path != SOURCE / "__init__.py"
}
MOST_FILES = 20
"""That one folder holds directly, without its ``__init__``."""


def imported_modules(path, *, at_start=False):
    """Modules of Skyless that a module imports: anywhere in it, or only while it is loaded itself."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in tree.body if at_start else ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: a relative import hides the layer"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            found = name if name in MODULES else name.rpartition(".")[0]
            if found in MODULES:
                yield found


def layer(module):
    below = module.removeprefix("skyless.")
    return LAYER_OF.get(below, LAYER_OF.get(below.split(".")[0]))


def folder(module):
    """The folder that holds a module; modules directly below ``skyless`` stand for themselves."""
    path = MODULES[module]
    return path.stem if path.parent == SOURCE else path.parent.relative_to(SOURCE).as_posix()


def circles(graph):
    """The first circle of a graph, as the names along it; None without one."""
    done = set()

    def visit(name, trail):
        if name in trail:
            return [*trail[trail.index(name) :], name]
        if name in done:
            return None
        for other in sorted(graph.get(name, ())):
            found = visit(other, [*trail, name])
            if found:
                return found
        done.add(name)
        return None

    return next(filter(None, (visit(name, []) for name in sorted(graph))), None)


def test_every_package_has_a_layer():
    assert [module for module in MODULES if layer(module) is None] == []


@pytest.mark.parametrize("module", sorted(MODULES))
def test_imports_go_down(module):
    own = layer(module)
    above = sorted({other for other in imported_modules(MODULES[module]) if layer(other) > own})
    assert not above, f"layer {own} imports from above: {', '.join(above)}"


def test_files_import_each_other_in_no_circle():
    graph = {module: set(imported_modules(path, at_start=True)) - {module} for module, path in MODULES.items()}
    assert circles(graph) is None


def test_folders_import_each_other_in_no_circle():
    graph = {}
    for module, path in MODULES.items():
        others = {folder(other) for other in imported_modules(path)}
        graph.setdefault(folder(module), set()).update(others - {folder(module)})
    assert circles(graph) is None


PAGE = (SOURCE / "dashboard" / "page").resolve()


def test_the_pages_modules_import_each_other_in_no_circle():
    """Neither the files of JavaScript nor their folders; those directly in ``page`` stand for themselves."""
    files, folders = {}, {}
    for path in PAGE.rglob("*.js"):
        if "vendor" in path.parts:
            continue
        found = re.findall(r'^import (?:[^"]* from )?"(\..*)";', path.read_text(encoding="utf-8"), re.MULTILINE)
        others = {(path.parent / name).resolve() for name in found}
        assert all(other.is_file() for other in others), path
        files[str(path)] = {str(other) for other in others}
        group, *groups = (file if file.parent == PAGE else file.parent for file in (path, *others))
        folders.setdefault(str(group), set()).update(str(other) for other in groups if other != group)
    assert files
    assert any(files.values())
    assert circles(files) is None
    assert circles(folders) is None


def package(module):
    path = MODULES[module]
    return module if path.name == "__init__.py" else module.rpartition(".")[0]


def test_a_package_names_the_modules_that_others_import():
    """Its docstring says which are public; commands are loaded by name."""
    public = {}
    for module, path in MODULES.items():
        for other in imported_modules(path):
            if package(other) not in {package(module), other, "skyless"}:
                public.setdefault(package(other), set()).add(other.rpartition(".")[2])
    named = {}
    for name in public:
        docstring = ast.get_docstring(ast.parse(MODULES[name].read_text("utf-8")))
        said = re.search(r"^Public: ([^.]*)\.", docstring, re.MULTILINE)
        named[name] = set(re.split(r",\s+", said[1])) if said else None
    exempt = {name for name in public if name.split(".")[1] == "cli"}
    assert {name: names for name, names in named.items() if name not in exempt} == {
        name: names for name, names in public.items() if name not in exempt
    }


def test_a_circle_is_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]


def test_no_folder_holds_more_files_than_one_can_look_over():
    counts = {}
    for path in SOURCE.rglob("*.py"):
        if path.name != "__init__.py":
            counts[path.parent] = counts.get(path.parent, 0) + 1
    assert {str(place): count for place, count in counts.items() if count > MOST_FILES} == {}
