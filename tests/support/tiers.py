"""The tiers of tests, and which a file has."""

import re

TIERS = {
    "unit": "no process, and no simulated site for longer than a second; the tier of tests without a marker",
    "site": "simulates a site, runs a command, or starts a program",
    "live": "a whole site of processes in real time, one test after the other",
    "statistical": "Monte Carlo, long fuzzing, heavy clients such as browsers: what takes more than some two seconds",
}
_TIER = f"({'|'.join(TIERS)})"
_TIER_OF_FILE = re.compile(rf"^pytestmark = (?:\[[^\]]*)?\bpytest\.mark\.{_TIER}\b", re.MULTILINE)
"""A file's marker, alone or in a list of several."""
_MARKED = re.compile(rf"\bpytest\.mark\.{_TIER}\b")


def file_tiers(text: str) -> set[str]:
    """Tiers of the tests in a file, by its text: some more than there are, and none less."""
    return set(_MARKED.findall(text)) | (set() if _TIER_OF_FILE.search(text) else {"unit"})
