"""One check and its report."""

from collections import Counter
from collections.abc import Sequence
from typing import Final, Literal

from msgspec import Struct

from skyless.run.mqtt.messages import FixMessage

Result = Literal["ok", "warning", "failed", "not checked"]


class Check(Struct, frozen=True):
    """What was found of one thing."""

    name: str
    result: Result
    finding: str
    """One sentence."""
    advice: str = ""
    """What to do next; empty where nothing is to be done."""


def judged(name: str, value: float, warn: float, fail: float, finding: str, advice: str) -> Check:
    """A check of a value that is better the smaller it is."""
    result: Result = "failed" if value > fail else "warning" if value > warn else "ok"
    return Check(name, result, finding, "" if result == "ok" else advice)


def residuals_check(name: str, words: str, fixes: Sequence[FixMessage]) -> Check:
    """Whether the residuals of fixes are as large as the site's noise figures let expect. ``words`` come before."""
    ratio = sum(fix.chi2 for fix in fixes) / max(sum(fix.dof for fix in fixes), 1)
    finding = f"{words}; squared residuals are {ratio:.2f} of what the site's noise figures let expect."
    advice = "Survey the anchors again, and look for what stands in the way."
    return judged(name, ratio, 2.0, 10.0, finding, advice)


_NO_HARDWARE: Final = "Simulated radios and emulated boards are checked as if they were real ones."


def summary(checks: Sequence[Check]) -> str:
    """How many checks had which result."""
    counts = Counter(check.result for check in checks)
    return ", ".join(f"{counts[result]} {result}" for result in ("ok", "warning", "failed", "not checked"))


def report(checks: Sequence[Check], heading: str) -> str:
    """The report as Markdown, what has failed first."""
    order = ("failed", "warning", "not checked", "ok")
    rows = [
        f"| {check.name} | {check.result} | {_cell(check.finding)} | {_cell(check.advice)} |"
        for check in sorted(checks, key=lambda one: order.index(one.result))
    ]
    head = ["| check | result | found | what to do |", "|---|---|---|---|"]
    return "\n".join([f"# {_cell(heading)}", "", f"{summary(checks)}. {_NO_HARDWARE}", "", *head, *rows, ""])


def _cell(text: str) -> str:
    return "".join(one if one.isprintable() else " " for one in text).replace("|", "\\|")
