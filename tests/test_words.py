"""One word for one thing: words that were replaced do not come back, and no constant name has two values."""

import ast
import re
from pathlib import Path

import pytest

import skyless

SOURCE = Path(skyless.__file__).parent
ROOT = Path(__file__).parents[1]
PATTERNS = ("src/skyless/**/*.py", "src/skyless/**/*.js", "src/skyless/**/*.html", "docs/**/*.md", "*.md")
TEXTS = sorted(
    path
    for pattern in PATTERNS
    for path in ROOT.glob(pattern)
    if "vendor" not in path.parts and path.name not in {"glossary.md", "CHANGELOG.md"}
)
MODULES = sorted(SOURCE.rglob("*.py"))

REPLACED = {
    r"told|tells?|telling": "reported, published, given, states",
    r"doubts?|doubted|doubtful": "extra variance, inflated covariance",
    r"believes?|believed": "accept, gate",
    r"agility|agilities": "process noise",
    r"restless": "inconsistent",
    r"anew": "again, from the start",
    r"hearsay": "relayed",
    r"liars?|lying": "faulty",
    r"whose ears": "which receiver",
    r"in step": "synchronised",
    r"not heard of": "offline",
    r"look again": "refresh",
    r"said by the fixes": "predicted σ",
    r"yardsticks?": "baseline, reference",
    r"deaf": "without receptions",
    r"sightings?": "confirmations",
    r"succession": "master election",
    r"hostile ears|ears?": "receiver",
    r"guests?": "client",
    r"seats?": "session",
    r"weighs?|weighed": "weight, variance scale",
    r"rooms? of (the )?code|this house|the house": "package, module, layer",
}
"""Words of version 0.1 as regular expressions, and what stands in their stead."""

VERBS = {
    "take",
    "follow",
    "settle",
    "elapse",
    "spread",
    "tell",
    "say",
    "put",
    "project",
    "leave_out",
    "take_back",
    "weigh",
}
"""Names of functions that do not say what is done."""

IDENTIFIERS = [
    "_tell",
    "_trust",
    "_doubt",
    "doubt_m2",
    "JOIN_DOUBT",
    "WEIGHT",
    "TRUST",
    "BENT",
    "WORTH",
    "CHI2",
    "HASTE",
    "CAUTION",
    "CALMING",
    "LOOSENED",
    "SOON_S",
    "unsettle",
    "follow_lag",
    "follow_clocks",
    "along_h",
    "joint_rest",
    "liar",
    "lying",
    "take_back",
    "leave_out",
    "_believes_relays",
    "made_of",
    "Claim",
    "claim_of",
    "Sightings",
    "Way",
    "Script",
    "Wanted",
    "Exchanged",
    "Seat",
    "Guest",
    "Speech",
    "FixBook",
    "PhaseBook",
    "NoiseBook",
    "AlmanacBook",
    "Succession",
    "DeafReceiver",
    "deaf_receiver",
    "latent_hosts",
    "yardstick",
    "reaching",
    "truths",
    "see_that_it_can_be_drawn",
    "Say",
    "place_of",
    "site_of_anchor",
]
"""Names of version 0.1 that were replaced."""

HEARING = {
    "anchor.py",
    "anchors/free.py",
    "evaluation/attacked_air.py",
    "evaluation/trusted_fixes.py",
    "evaluation/trusted_air.py",
    "trusted_receiver.py",
    "anchors/slots.py",
    "receiver.py",
    "simulation/world.py",
    "evaluation/anchor_stamps.py",
    "evaluation/fleet.py",
}
"""Only what stands where a radio's receptions arrive has methods named ``hear``."""


def definitions(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)]


def words(text):
    """The text with identifiers taken apart: ``rx_told`` and ``rxTold`` hold the word ``told``."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text.replace("_", " "))


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_replaced_words_do_not_come_back(path):
    found = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        for pattern, instead in REPLACED.items():
            match = re.search(rf"\b(?:{pattern})\b", words(line), re.IGNORECASE)
            if match:
                found.append(f"{path.name}:{number}: {match[0]} → {instead}")
    assert not found, "\n".join(found)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_functions_are_named_by_what_they_do(path):
    names = {node.name for node in definitions(path) if not isinstance(node, ast.ClassDef)}
    vague = {
        name for name in names if name.strip("_") in VERBS or re.match(r"_?(tell|say|doubt|believe|follow)_", name)
    }
    assert not vague
    if path.relative_to(SOURCE).as_posix() not in HEARING:
        assert not {name for name in names if re.match(r"_?hear(_|$)", name)}


def test_replaced_names_do_not_come_back():
    pattern = re.compile(rf"\b({'|'.join(IDENTIFIERS)})\b")
    found = []
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [getattr(node, key, None) for key in ("id", "attr", "name", "arg")]
            found += [f"{path.name}: {name}" for name in names if isinstance(name, str) and pattern.fullmatch(name)]
    assert found == []
    assert not {path.stem for path in MODULES} & set(IDENTIFIERS)


def public_constants():
    """Every public constant of a module, with the text of its value."""
    for path in MODULES:
        if path.parent.name == "dw1000":
            continue  # registers bear the names of the chip's manual, in the driver and in the model
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            value = getattr(node, "value", None)
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            if value is None or len(targets) != 1:
                continue
            names = targets[0].elts if isinstance(targets[0], ast.Tuple) else targets
            for position, name in enumerate(names):
                if isinstance(name, ast.Name) and re.fullmatch(r"[A-Z][A-Z0-9_]+", name.id):
                    text = ast.unparse(value) if len(names) == 1 else f"{position} of {ast.unparse(value)}"
                    yield name.id, text, path.relative_to(SOURCE).as_posix()


def test_no_constant_has_two_values():
    values = {}
    for name, text, place in public_constants():
        values.setdefault(name, {}).setdefault(text, []).append(place)
    assert {name: found for name, found in values.items() if len(found) > 1} == {}
