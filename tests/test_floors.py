"""The house: every room imports only from its own floor and from those below (``docs/architecture.md``)."""

import ast
from pathlib import Path

import pytest

import skyless

SOURCE = Path(skyless.__file__).parent

FLOORS = (
    {"constants", "errors", "methods", "ticks", "compiled", "eights", "addresses", "firmware"},
    {"air", "site"},
    {"clocks", "uncertainty"},
    {"positioning"},
    {"anchor", "receiver", "succession"},
    {"simulation", "radios", "recordings", "outputs"},
    {"experiments", "nodes", "planning"},
    {"cli", "dashboard"},
)
FLOOR_OF = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
MODULES = sorted(path for path in SOURCE.rglob("*.py") if path != SOURCE / "__init__.py")


def room(path):
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def imported_rooms(path):
    """Rooms of Skyless that a module imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: a relative import hides the floor"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            package, _, rest = name.partition(".")
            if package == "skyless" and rest:
                yield rest.split(".")[0]


def test_every_room_has_a_floor():
    assert {room(path) for path in MODULES} <= FLOOR_OF.keys()


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_imports_go_down(path):
    floor = FLOOR_OF[room(path)]
    above = sorted({name for name in imported_rooms(path) if FLOOR_OF[name] > floor})
    assert not above, f"floor {floor} imports from above: {', '.join(above)}"


def test_modules_import_each_other_in_no_circle():
    graph = {module_name(path): modules_imported_at_start(path) for path in MODULES}
    done: set[str] = set()

    def visit(name, trail):
        assert name not in trail, f"a circle of imports: {' → '.join([*trail, name])}"
        if name not in done:
            for other in sorted(graph.get(name, ())):
                visit(other, [*trail, name])
            done.add(name)

    for name in graph:
        visit(name, [])


def module_name(path):
    parts = path.relative_to(SOURCE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def modules_imported_at_start(path):
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return {name for name in found if name.startswith("skyless.")} - {module_name(path)}
