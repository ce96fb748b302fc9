"""What one check has found."""

from collections.abc import Collection
from typing import Literal

from msgspec import Struct

from skyless.run.mqtt.messages import FixMessage

Result = Literal["failed", "warning", "not checked", "ok"]


class Check(Struct, frozen=True):
    """What was found of one thing."""

    name: str
    result: Result
    finding: str
    """One sentence."""
    advice: str = ""
    """What to do next; empty where nothing is to be done."""


def sentence(words: str) -> str:
    """Words that begin with a capital letter and end with a full stop."""
    return f"{words[0].upper()}{words[1:]}."


def judged(name: str, value: float, warn: float, fail: float, finding: str, advice: str) -> Check:
    """A check of a value that is better the smaller it is."""
    result: Result = "failed" if value > fail else "warning" if value > warn else "ok"
    return Check(name, result, finding, "" if result == "ok" else advice)


def residuals_check(name: str, words: str, fixes: Collection[FixMessage]) -> Check:
    """Whether the residuals of fixes are as large as the site's noise figures let expect. ``words`` come before."""
    ratio = sum(fix.chi2 for fix in fixes) / max(sum(fix.dof for fix in fixes), 1)
    finding = f"{words}; squared residuals are {ratio:.2f} of what the site's noise figures let expect."
    advice = "Survey the anchors again, and look for what stands in the way."
    return judged(name, ratio, 2.0, 10.0, finding, advice)
