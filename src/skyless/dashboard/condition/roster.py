"""Which names the page's server takes in, and how many it does not: a broker that invents names cannot fill the memory.

What is not taken in is neither shown nor judged, but counted. No I/O; the time is passed in.
"""

from typing import Final

MAX_NAMES: Final = {"tag": 200_000, "anchor": 20_000}
"""Names of a kind that are taken in."""

MAX_OTHERS: Final = 2_000
"""Names of all other kinds together."""

_COUNT_S: Final = 10.0
"""Names that were not taken in are counted again after this time, so that the count falls when they end."""


class Roster:
    """The names of one site."""

    def __init__(self) -> None:
        self._names: dict[str, set[str]] = {}
        self._left_out: dict[str, set[int]] = {}
        """Hashes of the names that were not taken in since the last count."""
        self._counted: dict[str, int] = {}
        self._counted_s = float("-inf")

    def admits(self, kind: str, name: str) -> bool:
        """Whether a name is taken in: the first ones are, for good."""
        group, entry, most = kind, name, MAX_NAMES.get(kind)
        if most is None:
            group, entry, most = "", f"{kind}/{name}", MAX_OTHERS
        names = self._names.setdefault(group, set())
        if entry in names:
            return True
        if len(names) < most:
            names.add(entry)
            return True
        left_out = self._left_out.setdefault(group, set())
        if len(left_out) < most:
            left_out.add(hash(entry))
        return False

    def size(self, kind: str) -> int:
        """How many names of a kind are taken in."""
        return len(self._names.get(kind, ()))

    def left_out(self, kind: str, now_s: float) -> int:
        """How many names of a kind, tag or anchor, were not taken in; at most as many as are taken in are counted."""
        if now_s - self._counted_s >= _COUNT_S:
            self._counted = {group: len(names) for group, names in self._left_out.items()}
            self._left_out, self._counted_s = {}, now_s
        return max(self._counted.get(kind, 0), len(self._left_out.get(kind, ())))
