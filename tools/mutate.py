"""Change one place of a module at a time and run its tests: what they do not find, they do not test.

``scripts/mutate`` measures the modules of ``tests/mutants.toml``, ``scripts/mutate run/alarms.py`` one of them, with
its own tests, and fails where they find too few. Modules and tests of your choice:
``scripts/mutate core/site.py tests/core/test_digest.py``. With ``--spare`` it lists the tests whose lines and mutants
are all found by others.
What a whole measurement depends on is kept in ``tests/mutants_measured.json``: a test of the statistical tier measures
again what has changed since.

Mutants: a comparison, ``and`` and ``or``, the condition of an ``if``, plus and minus, a number, a returned value.

The tests are imported once. Each mutant is a fork of that process, in which the code of one function is replaced and
those tests run that reach the changed line.
"""

import argparse
import ast
import gc
import os
import random
import select
import signal
import sys
import threading
import time
import tomllib
from collections import Counter
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from hashlib import sha256
from io import StringIO
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any, Final, cast

import msgspec
import pytest
from hypothesis import Phase, settings
from msgspec import Struct

ROOT: Final = Path(__file__).parents[1]
SOURCE: Final = ROOT / "src" / "skyless"
TABLE: Final = ROOT / "tests" / "mutants.toml"
MEASURED: Final = ROOT / "tests" / "mutants_measured.json"
LEAST_SHARE: Final = 0.95
"""Of the mutants that are not equal in effect, those that the tests should find."""
_SLOWER: Final = 5.0
"""Tests that take this many times as long as without the mutant are taken to run for ever."""
_GRACE_S: Final = 5.0

_OTHER: Final[dict[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip


class Equal(Struct, forbid_unknown_fields=True):
    """A mutant that nothing can find, as ``Mutant.name`` has it, and why."""

    mutant: str
    why: str


class Entry(Struct, forbid_unknown_fields=True):
    """A module of the table: its tests, and its mutants that are equal in effect."""

    tests: list[str]
    equal: list[Equal] = []


class Mutant(Struct, frozen=True):
    """A place of a module, and its code with that place changed."""

    line: int
    name: str
    function: tuple[str, int]
    """Qualified name and first line of the outermost function that contains the place."""
    code: CodeType
    text: str
    """The module with that place changed."""


# Mutants of a module.


def mutants_of(path: Path) -> list[Mutant]:
    """All mutants of a module, in the order of its lines."""
    text = path.read_text("utf-8")
    found = []
    for number in range(len(list(_places(ast.parse(text))))):
        tree = ast.parse(text)
        function, node = list(_places(tree))[number]
        before, part = _shown(node), node.test if isinstance(node, ast.If | ast.IfExp) else node
        begin, end = _offset(text, part.lineno, part.col_offset), _offset(text, part.end_lineno, part.end_col_offset)
        _change(node)
        after = ast.unparse(node.test if isinstance(node, ast.If | ast.IfExp) else node)
        after = after if isinstance(node, ast.Return) else f"({after})"
        code = compile(ast.fix_missing_locations(tree), str(path), "exec")
        first = min([function.lineno, *(one.lineno for one in function.decorator_list)])
        changed = next(one for one in _codes(code) if (one.co_firstlineno, one.co_name) == (first, function.name))
        where = f" in {text.splitlines()[node.lineno - 1].strip()}" if isinstance(node, ast.Constant) else ""
        name = f"{before} -> {_shown(node)}{where}"
        changed_text = (text.encode()[:begin] + after.encode() + text.encode()[end:]).decode()
        found.append(Mutant(node.lineno, name, (changed.co_qualname, first), changed, changed_text))
    return found


def _offset(text: str, line: int | None, column: int | None) -> int:
    """Number of bytes before a place, as ``ast`` names it."""
    assert line is not None
    assert column is not None
    return sum(len(one.encode()) for one in text.splitlines(keepends=True)[: line - 1]) + column


def _places(tree: ast.AST, function: ast.FunctionDef | ast.AsyncFunctionDef | None = None) -> Iterator[Any]:
    for node in ast.iter_child_nodes(tree):
        inside = function or (node if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) else None)
        if function and _can_change(node):
            yield function, node
        if not isinstance(node, ast.JoinedStr):  # texts are not what decides
            yield from _places(node, inside)


def _can_change(node: ast.AST) -> bool:
    match node:
        case ast.Compare(ops=[_]) | ast.BoolOp() | ast.If() | ast.IfExp() | ast.BinOp(op=ast.Add() | ast.Sub()):
            return True
        case ast.Constant(value=int() | float()):
            return not isinstance(node.value, bool)
        case ast.Return(value=ast.expr()):
            return not (isinstance(node.value, ast.Constant) and node.value.value is None)
    return False


def _change(node: Any) -> None:  # noqa: ANN401 - any of _can_change
    match node:
        case ast.Compare():
            node.ops = [_OTHER[type(node.ops[0])]()]
        case ast.BoolOp():
            node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        case ast.If() | ast.IfExp():
            node.test = ast.UnaryOp(ast.Not(), node.test)
        case ast.BinOp():
            node.op = ast.Sub() if isinstance(node.op, ast.Add) else ast.Add()
        case ast.Constant():
            node.value = cast(float, node.value) + 1
        case ast.Return():
            node.value = ast.Constant(None)


def _shown(node: ast.AST) -> str:
    return f"if {ast.unparse(node.test)}" if isinstance(node, ast.If) else ast.unparse(node)


def _codes(code: CodeType) -> Iterator[CodeType]:
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from _codes(constant)


# Tests in forks.


class Runs:
    """A plugin of pytest that runs the collected tests once for each mutant."""

    def __init__(self, path: Path, mutants: list[Mutant], *, to_the_end: bool) -> None:
        self.path, self.mutants, self.to_the_end = path, mutants, to_the_end
        self.lines: dict[str, frozenset[int]] = {}
        """Lines of the module that each test reaches."""
        self.found: list[list[str]] = []
        """For each mutant the tests that found it: the first one, or all."""
        self._failed: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._failed.append(report.nodeid)

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if session.testsfailed:
            raise pytest.UsageError("tests that cannot be collected")
        failed, lines, took_s = _forked(lambda: self._reach(session.items), 3600.0)
        if failed:
            raise pytest.UsageError(f"tests that fail without a mutant: {failed}")
        self.lines = {name: frozenset(numbers) for name, numbers in lines.items()}
        functions = [one for one in gc.get_objects() if isinstance(one, FunctionType)]
        functions = [one for one in functions if one.__code__.co_filename == str(self.path)]
        finds: Counter[str] = Counter()  # those that find most begin
        for number, mutant in enumerate(self.mutants):
            items = [item for item in session.items if mutant.line in self.lines[item.nodeid]]
            if not self.to_the_end:
                items.sort(key=lambda item: -finds[item.nodeid])
            found = _forked(
                lambda m=mutant, i=items: self._find(m, i, functions),
                _GRACE_S + _SLOWER * sum(took_s[item.nodeid] for item in items),
            )
            self.found.append(["(no end)"] if found is None else found)
            finds.update(self.found[-1])
            if sys.stderr.isatty():
                print(f"\r{number + 1} of {len(self.mutants)} mutants", end="", file=sys.stderr)
        return True

    def _reach(self, items: list[pytest.Item]) -> Any:  # noqa: ANN401 - failed tests, lines and durations of all
        path, lines, took_s, now = str(self.path), {}, {}, set()

        def traced(frame: FrameType, event: str, _: Any) -> Any:  # noqa: ANN401 - as sys.settrace has it
            if frame.f_code.co_filename != path:
                return None
            if event == "line":
                now.add(frame.f_lineno)
            return traced

        threading.settrace(traced)
        for item, following in zip(items, [*items[1:], None], strict=True):
            now.clear()
            began_s = time.monotonic()
            sys.settrace(traced)
            item.ihook.pytest_runtest_protocol(item=item, nextitem=following)
            sys.settrace(None)
            lines[item.nodeid] = sorted(now)
            took_s[item.nodeid] = time.monotonic() - began_s
        return self._failed, lines, took_s

    def _find(self, mutant: Mutant, items: list[pytest.Item], functions: list[FunctionType]) -> list[str]:
        for function in functions:
            if (function.__qualname__, function.__code__.co_firstlineno) == mutant.function:
                function.__code__ = mutant.code
        for item, following in zip(items, [*items[1:], None], strict=True):
            item.ihook.pytest_runtest_protocol(item=item, nextitem=following)
            if self._failed and not self.to_the_end:
                break
        return self._failed


def _forked(work: Any, limit_s: float) -> Any:  # noqa: ANN401 - whatever JSON can hold
    """The result of work in a fork of this process; None if it takes too long or ends without one."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.setsid()
        nothing = os.open(os.devnull, os.O_RDWR)
        os.dup2(nothing, 1)
        os.dup2(nothing, 2)
        try:
            with os.fdopen(writer, "wb") as pipe:
                pipe.write(msgspec.json.encode(work()))
        finally:
            os._exit(0)
    os.close(writer)
    text, end_s = b"", time.monotonic() + limit_s
    try:
        while select.select([reader], [], [], max(0.0, end_s - time.monotonic()))[0]:
            if not (part := os.read(reader, 1 << 16)):
                break
            text += part
    finally:  # also after Ctrl-C, which the child does not get
        os.close(reader)
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
    return msgspec.json.decode(text) if text else None


# What is said.


def digest_of(module: str, entry: Entry) -> str:
    """What a measurement depends on: the module, its tests and the list of its equal mutants."""
    texts = [(SOURCE / module).read_bytes(), *((ROOT / one).read_bytes() for one in entry.tests)]
    return sha256(b"\0".join([*texts, msgspec.json.encode(entry)])).hexdigest()[:16]


def measured() -> dict[str, str]:
    """Digest of each module whose tests were last seen to find enough."""
    found: dict[str, str] = msgspec.json.decode(MEASURED.read_bytes()) if MEASURED.exists() else {}
    return found


def table() -> dict[str, Entry]:
    """Modules that are measured, with their tests."""
    return msgspec.convert(tomllib.loads(TABLE.read_text("utf-8")), dict[str, Entry])


def judged(module: str, entry: Entry, *, spare: bool, number: int | None = None) -> bool:
    """Measure a module and say which mutants live; whether the tests find enough of them."""
    path = SOURCE / module
    mutants = mutants_of(path)
    if number is not None:
        mutants = sorted(random.Random(1).sample(mutants, min(number, len(mutants))), key=lambda one: one.line)
    runs = Runs(path, mutants, to_the_end=spare)
    settings.register_profile("mutants", deadline=None, derandomize=True, phases=(Phase.explicit, Phase.generate))
    options = ["-p", "no:cacheprovider", "-p", "no:timeout", "--hypothesis-profile=mutants", "--tiers", "unit,site"]
    with redirect_stdout(StringIO()) as said:
        pytest.main([*options, *(str(ROOT / one) for one in entry.tests)], plugins=[runs])
    if len(runs.found) < len(mutants):
        print(f"{module}: its tests do not run: {said.getvalue()}")
        return False
    reasons = {one.mutant: one.why for one in entry.equal}
    alive = [one for one, found in zip(mutants, runs.found, strict=True) if not found]
    for one in alive:
        print(f"{module}:{one.line}: {reasons.get(one.name, 'LIVES')}: {one.name}")
    for name in reasons.keys() - {one.name for one in alive} if number is None else ():
        print(f"{TABLE.name}: {module}: is found, or is no mutant any more: {name}")
    lives = sum(one.name not in reasons for one in alive)
    different = len(mutants) - len(alive) + lives
    print(f"{module}: {different - lives} of {different} mutants are found ({1 - lives / different:.1%}), "
          f"{len(alive) - lives} are equal in effect")  # fmt: skip
    if spare:
        _say_spare(runs)
    return lives <= (1.0 - LEAST_SHARE) * different


def _say_spare(runs: Runs) -> None:
    """Keep tests greedily, those that add most first; what adds nothing is spare."""
    has: dict[str, set[Any]] = {name: set(lines) for name, lines in runs.lines.items()}
    for mutant, found in zip(runs.mutants, runs.found, strict=True):
        for name in found:
            has.get(name, set()).add((mutant.line, mutant.name))
    covered: set[Any] = set()
    while has:
        name = max(has, key=lambda one: len(has[one] - covered))
        if not has[name] - covered:
            break
        covered |= has.pop(name)
    for name in has:
        print(f"spare: {name}")


def main() -> int:
    """Measure the modules that are asked for, each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="modules below src/skyless; files of tests")
    parser.add_argument("--spare", action="store_true", help="list the tests that find nothing of their own")
    parser.add_argument("--number", type=int, help="so that fewer mutants are tried: this number, always the same ones")
    parser.add_argument("--only-say", action="store_true", help="do not write tests/mutants_measured.json")
    asked = parser.parse_args()
    entries = table()
    names = [name.removeprefix("src/skyless/") for name in asked.names]
    modules = [name for name in names if (SOURCE / name).is_file()]
    tests = [name for name in names if name not in modules]
    for name in tests:
        if not (ROOT / name).exists():
            parser.error(f"{name} is no module of src/skyless and no file of tests")
    for module in modules:
        if not tests and module not in entries:
            parser.error(f"{module} is not in {TABLE.relative_to(ROOT)}; name its tests, too")
    good = True
    for module in modules or entries:
        entry = msgspec.structs.replace(entries.get(module, Entry([])), **({"tests": tests} if tests else {}))
        child = os.fork()
        if child == 0:
            code = 3
            try:
                code = 0 if judged(module, entry, spare=asked.spare, number=asked.number) else 1
                sys.stdout.flush()
            finally:
                os._exit(code)
        is_good = os.waitpid(child, 0)[1] == 0
        if is_good and not (tests or asked.number or asked.only_say):
            kept = {name: digest for name, digest in measured().items() if name in entries}
            text = msgspec.json.encode({**kept, module: digest_of(module, entry)}, order="sorted")
            MEASURED.write_bytes(msgspec.json.format(text) + b"\n")
        good &= is_good
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
