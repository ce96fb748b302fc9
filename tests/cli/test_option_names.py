"""One name for one thing: an option has one type and one meaning over all commands."""

import re
import types
from collections import defaultdict
from pathlib import Path
from typing import Annotated, Literal, Union, get_args, get_origin

import pytest

from skyless.cli.main import main, program

pytestmark = pytest.mark.site

WORDS = 2
"""First words of the help that all commands share; what differs follows."""

OF_SEVERAL_TYPES = {
    "--heights": "heights; of a tag's sensor, which are many, a table of them",
    "--hub": "of a site the file of its line; where sites are shown the hub's address",
    "--site": "a site file; where a site is emulated or shown also lab",
    "--to": "a folder; where a site runs, targets",
}
"""Options whose type differs, and what they mean all the same."""

OF_SEVERAL_MEANINGS = {
    "--to": "where something goes; where the history is asked, when a range of time ends",
    "--from": "where something comes from; where the history is asked, when a range of time begins",
    "--hub": OF_SEVERAL_TYPES["--hub"],
}


def commands(app, path=()):
    """Every command and its options."""
    if app.default_command is not None:
        yield path, [one for one in app.assemble_argument_collection(parse_docstring=True) if one.name.startswith("--")]
    for name in app:
        if not name.startswith("-"):
            yield from commands(app[name], (*path, name))


def kind(hint):
    """A type without None and validators; literals and texts alike, as both are words of the user."""
    if get_origin(hint) is Annotated:
        return kind(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType):
        (hint,) = {kind(one) for one in get_args(hint) if one is not type(None)}
        return hint
    if get_origin(hint) is Literal:
        return type(get_args(hint)[0])
    return hint


@pytest.fixture(scope="module")
def options():
    """Of each name the commands that have it, with type and help."""
    found = defaultdict(dict)
    for path, arguments in commands(program()):
        for argument in arguments:
            found[argument.name][" ".join(path)] = (
                kind(argument.hint),
                " ".join((argument.parameter.help or "").split()),
            )
    assert len(found) > 100
    return found


def test_a_name_has_one_type(options):
    wrong = {
        name: uses
        for name, uses in options.items()
        if len({one for one, _ in uses.values()}) > 1 and name not in OF_SEVERAL_TYPES
    }
    assert wrong == {}
    assert {one for one, _ in options["--site"].values()} == {str, Path}


def test_a_name_has_one_meaning(options):
    """Which its first words say."""
    wrong = {}
    for name, uses in options.items():
        first = {" ".join(re.findall(r"\w+", words)[:WORDS]) for _, words in uses.values()}
        if len(first) > 1 and name not in OF_SEVERAL_MEANINGS:
            wrong[name] = first
    assert wrong == {}


def test_every_command_has_json():
    assert {path for path, arguments in commands(program()) if "--json" not in {one.name for one in arguments}} == set()


def test_every_option_has_help(options):
    assert [
        (name, command) for name, uses in options.items() for command, (_, words) in uses.items() if not words
    ] == []


@pytest.mark.statistical
def test_a_number_that_is_none_is_refused_by_every_option(options, capsys):
    """Before the command begins: NaN, and infinities."""
    numbers = [(name, command) for name, uses in options.items() for command, (one, _) in uses.items() if one is float]
    assert len(numbers) > 40
    for name, command in numbers:
        for value in ("nan", "inf", "-inf"):
            assert main([*command.split(), f"{name}={value}", *_POSITIONAL.get(command, ())]) == 2, (name, command)
            err = capsys.readouterr().err
            assert (err.count("\n"), name in err, "Traceback" in err) == (1, True, False), err


_POSITIONAL = dict.fromkeys(
    ("benchmark", "calibrate", "plan", "replay", "site new", "site check", "board"), (__file__,)
)
_POSITIONAL |= dict.fromkeys(("site keys new", "site keys rotate", "site keys revoke"), ("x",))
_POSITIONAL["study"] = ("room",)
_POSITIONAL |= dict.fromkeys(("history track", "history contacts"), ("x",))
_POSITIONAL["history run"] = ("--to", "x")
_POSITIONAL["hub init"] = ("x",)
