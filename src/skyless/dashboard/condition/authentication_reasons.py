"""What can be wrong with codes and keys of a live site: each function looks for one cause and gives its reason. No I/O.

Nothing is found at a site without keys and of tags without its public key.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Final, Literal

from skyless.authentication.fault import Fault
from skyless.dashboard.condition.evidence import GRACE_S, Evidence, Node
from skyless.dashboard.condition.reasons import Reason, alike, counted, listed, names_of, verb
from skyless.mqtt.messages import AnchorHealth, TagHealth

CHAIN_ENDS_S: Final = 60 * 86400.0
"""A key chain that ends within this time needs a successor soon."""

_WHY_NO_CODES: Final[Mapping[str, str]] = {
    Fault.NO_TIME: "its program does not know the time yet",
    Fault.NO_CHAIN: "no key chain holds now",
    Fault.CLOCK_WRONG: "its clock differs from those of the other anchors",
}
_ADVICE_NO_CODES: Final[Mapping[str, str]] = {
    Fault.NO_TIME: "See the log of its program.",
    Fault.NO_CHAIN: "See with skyless site keys show when a chain begins, and whether the anchor has its files.",
    Fault.CLOCK_WRONG: "Synchronise the clock of its computer, as by NTP.",
}
_NOT_ACCEPTED: Final[Mapping[str, str]] = {
    Fault.BAD_CODE: "have a wrong code: they are forged, or the anchor has another seed",
    Fault.REPEATED: "come a second time: somebody repeats them",
    Fault.NO_CODE: "have no code: somebody else sends them, or the anchor has no keys",
    Fault.REVOKED_CHAIN: "are of a key chain that was replaced: the anchor, or somebody else, still uses it",
    Fault.LATE: "come too late: somebody delays them, or a clock is wrong",
    Fault.EARLY: "come too early: a clock is wrong, or they are forged",
}
_FORGED: Final[frozenset[str]] = frozenset({Fault.BAD_CODE, Fault.REPEATED, Fault.NO_CODE})
"""Where tags do not verify beacons, these may be in their positions."""

_Statements = dict[str, dict[tuple[str, str], str]]
"""By anchor: the fault that each node, by kind and name, states of its beacons."""


def authentication_reasons(evidence: Evidence, now_s: float) -> Iterable[Reason]:
    """All that is found."""
    tags = {
        name: node.health
        for name, node in evidence.of("tag")
        if node.reports(now_s) and isinstance(node.health, TagHealth) and node.health.trust is not None
    }
    anchors = {
        name: node.health
        for name, node in evidence.of("anchor")
        if node.reports(now_s) and isinstance(node.health, AnchorHealth)
    }
    keyed = {name: health for name, health in anchors.items() if _has_keys(health)}
    yield from _clock(tags)
    yield from _not_verified(evidence, tags, now_s)
    yield from _chains(keyed)
    yield from _codes(evidence, keyed, now_s)
    yield from _keys(evidence, keyed, anchors, now_s)
    yield from _forged(evidence, tags, anchors, now_s)


def _has_keys(health: AnchorHealth) -> bool:
    return health.chain is not None or health.chain_ends_unix_s is not None or health.code_fault is not None


def _left_s(health: AnchorHealth) -> float:
    """Until its last key chain ends, by its own clock."""
    return float("inf") if health.chain_ends_unix_s is None else health.chain_ends_unix_s - health.unix_s


def _clock(tags: Mapping[str, TagHealth]) -> Iterable[Reason]:
    """Clocks of tags that differ from the site's by more than the tags' bounds."""
    errors_s = {name: health.clock_error_s for name, health in tags.items() if health.clock_error_s is not None}
    if not errors_s:
        return
    worst_s = max(errors_s.values(), key=abs)
    size = f"{abs(worst_s):.2f} s" if abs(worst_s) < 1.0 else f"{abs(worst_s):.1f} s"
    if len(errors_s) == 1:
        text = f"the clock of tag {next(iter(errors_s))} is {size} {'ahead of' if worst_s > 0 else 'behind'} the site's"
    else:
        text = f"the clocks of {listed('tag', list(errors_s))} differ from the site's by up to {size}"
    advice = "Synchronise the clocks of its computer and of the anchors', as by NTP: they decide what came in time."
    verified = all(tags[name].is_verified for name in errors_s)
    yield Reason("clock", "warning" if verified else "bad", text, advice, names_of("tag", list(errors_s)))


def _not_verified(evidence: Evidence, tags: Mapping[str, TagHealth], now_s: float) -> Iterable[Reason]:
    """Tags that receive beacons none of which is verified; where their clock is wrong, that is another reason."""
    found = {
        name: health
        for name, health in tags.items()
        if not health.is_verified and health.clock_error_s is None and _receives(evidence.nodes["tag", name], now_s)
    }
    if not found:
        return
    common = Counter(fault for health in found.values() for fault in health.faults.values()).most_common(1)
    text = f"nothing that {listed('tag', list(found))} {verb(found, 'receives', 'receive')} is verified"
    text += f" ({common[0][0].replace('-', ' ')})" if common else ""
    advice = (
        "Its positions may be forged. See whether the anchors send codes, whether its clock is right, and whether "
        "it has this site's public key."
    )
    yield Reason("not-verified", "bad", text, advice, names_of("tag", list(found)))


def _receives(tag: Node, now_s: float) -> bool:
    """Whether a tag that has not just started has received beacons between its last two messages."""
    now, before = tag.health, tag.previous
    if not isinstance(now, TagHealth) or not isinstance(before, TagHealth) or tag.since_s is None:
        return False
    return now_s - tag.since_s > GRACE_S and now.receptions > before.receptions


def _chains(keyed: Mapping[str, AnchorHealth]) -> Iterable[Reason]:
    """Key chains that have ended or end soon."""
    advice = "Make a successor with skyless site keys rotate, and give the anchors its files."
    ended = [name for name, health in keyed.items() if _left_s(health) <= 0.0]
    if ended:
        text = (
            f"the key chain of {_all_or_some(ended, keyed)} has ended: {verb(ended, 'it sends', 'they send')} no codes"
        )
        yield Reason("chain-ended", "bad", text, advice, names_of("anchor", ended))
    soon = {name: _left_s(health) for name, health in keyed.items() if 0.0 < _left_s(health) < CHAIN_ENDS_S}
    if soon:
        least_s = min(soon.values())
        left = f"{least_s // 86400.0:.0f} days" if least_s >= 2 * 86400.0 else f"{least_s // 3600.0:.0f} hours"
        text = f"the key chain of {_all_or_some(list(soon), keyed)} ends in {left}"
        yield Reason("chain", "warning", text, advice, names_of("anchor", list(soon)))


def _all_or_some(names: list[str], keyed: Mapping[str, AnchorHealth]) -> str:
    return f"all {len(names)} anchors" if 1 < len(names) == len(keyed) else listed("anchor", names)


def _codes(evidence: Evidence, keyed: Mapping[str, AnchorHealth], now_s: float) -> Iterable[Reason]:
    """Anchors with keys that send without codes, and why."""
    without = {
        name: health.code_fault
        for name, health in keyed.items()
        if health.code_fault is not None
        and _left_s(health) > 0.0
        and not evidence.in_grace(now_s, evidence.nodes["anchor", name])
    }
    if not without:
        return
    groups = alike(without)
    whys = [(_WHY_NO_CODES.get(fault, fault.replace("-", " ")), names) for fault, names in groups]
    text = f"{listed('anchor', list(without))} {verb(without, 'sends', 'send')} no codes: "
    text += "; ".join(why if len(groups) == 1 else f"{why} ({listed('anchor', names)})" for why, names in whys)
    advice = _ADVICE_NO_CODES.get(groups[0][0], "See the log of its program.")
    yield Reason("codes", "warning", text, advice, names_of("anchor", list(without)))


def _keys(
    evidence: Evidence, keyed: Mapping[str, AnchorHealth], anchors: Mapping[str, AnchorHealth], now_s: float
) -> Iterable[Reason]:
    """Anchors without keys among others that have them."""
    without = [
        name for name in anchors if name not in keyed and not evidence.in_grace(now_s, evidence.nodes["anchor", name])
    ]
    if keyed and without:
        others = f"{len(keyed)} other{verb(keyed, ' has', 's have')}"
        text = f"{listed('anchor', without)} {verb(without, 'has', 'have')} no keys, though {others} them"
        advice = "Start it with the site's keys (--keys): tags that verify beacons do not use it."
        yield Reason("keys", "warning", text, advice, names_of("anchor", without))


def _forged(
    evidence: Evidence, tags: Mapping[str, TagHealth], anchors: Mapping[str, AnchorHealth], now_s: float
) -> Iterable[Reason]:
    """Anchors whose beacons, or beacons in whose name, tags and other anchors do not accept."""
    statements = _that_count(_statements(evidence, tags, anchors, now_s))
    if not statements:
        return
    faults = {name: Counter(by.values()).most_common(1)[0][0] for name, by in statements.items()}
    parts = []
    for fault, names in alike(faults):
        words = _NOT_ACCEPTED.get(fault, f"are not accepted ({fault.replace('-', ' ')})")
        finders = _finders(dict.fromkeys(node for name in names for node in statements[name]))
        parts.append(f"beacons in the name of {listed('anchor', names)} {words} (found by {finders})")
    advice = "Tags that verify beacons do not use these. See that anchor's log and keys, and who else transmits there."
    without_key = [
        name
        for name, node in evidence.of("tag")
        if node.has_fix(now_s) and isinstance(node.health, TagHealth) and node.health.trust is None
    ]
    level: Literal["warning", "bad"] = "warning"
    if without_key and not _FORGED.isdisjoint(faults.values()):
        level = "bad"
        advice += (
            f" Do not rely on {listed('tag', without_key)}: {verb(without_key, 'it verifies', 'they verify')} nothing."
        )
    yield Reason("forged", level, "; ".join(parts), advice, names_of("anchor", list(faults)))


def _statements(
    evidence: Evidence, tags: Mapping[str, TagHealth], anchors: Mapping[str, AnchorHealth], now_s: float
) -> _Statements:
    """What nodes state of anchors, apart from what other reasons explain: a wrong clock, and anchors without codes."""
    found: _Statements = {}

    def add(node: tuple[str, str], faults: Mapping[str, str], *, is_clock_wrong: bool) -> None:
        for anchor, fault in faults.items():
            is_explained = fault in {Fault.LATE, Fault.EARLY} and is_clock_wrong
            is_explained |= fault == Fault.NO_CODE and _may_be_without_codes(evidence, anchor, now_s)
            if not is_explained:
                found.setdefault(anchor, {})[node] = fault

    for name, tag in tags.items():
        add(("tag", name), tag.faults, is_clock_wrong=tag.clock_error_s is not None or not tag.is_verified)
    for name, anchor in anchors.items():
        add(("anchor", name), anchor.faults, is_clock_wrong=anchor.code_fault == Fault.CLOCK_WRONG)
    return found


def _may_be_without_codes(evidence: Evidence, anchor: str, now_s: float) -> bool:
    """Whether an anchor has lately stated that it sends without codes, or has just started."""
    node = evidence.nodes.get(("anchor", anchor))
    if node is None:
        return False
    lately = now_s - node.health_s < GRACE_S
    return evidence.in_grace(now_s, node) or (lately and node.codes_for_s(now_s) < GRACE_S)


def _that_count(statements: _Statements) -> _Statements:
    """Without those of an anchor of which more nodes state faults: one with a wrong seed finds them everywhere."""

    def count(node: tuple[str, str]) -> int:
        return len(statements.get(node[1], ())) if node[0] == "anchor" else 0

    chosen = {
        name: {node: fault for node, fault in by.items() if count(node) <= len(by)} for name, by in statements.items()
    }
    return {name: by for name, by in chosen.items() if by}


def _finders(nodes: Iterable[tuple[str, str]]) -> str:
    """``2 tags and anchor 3``."""
    by_kind: dict[str, list[str]] = {}
    for kind, name in nodes:
        by_kind.setdefault(kind, []).append(name)
    return " and ".join(counted(kind, names) for kind, names in by_kind.items())
