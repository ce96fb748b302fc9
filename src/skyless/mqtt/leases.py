"""Who has asked for something that costs work or bandwidth, and until when: a request is repeated or ends by itself.

No clock: times are passed in, by any clock that does not go back.
"""

from typing import Final

MOST_LEASES: Final = 64
MAX_LEASE_S: Final = 60.0


class Leases:
    """The leases on one thing, each by the name of its holder."""

    def __init__(self) -> None:
        self._until_s: dict[str, float] = {}

    @property
    def are_held(self) -> bool:
        """Whether anybody holds one, as of the last call with a time."""
        return bool(self._until_s)

    def holds(self, by: str) -> bool:
        """Whether this one does."""
        return by in self._until_s

    def grant(self, by: str, lease_s: float, now_s: float) -> bool:
        """Begin or extend a lease; False where too many hold one."""
        self.expire(now_s)
        if by not in self._until_s and len(self._until_s) >= MOST_LEASES:
            return False
        self._until_s[by] = now_s + min(max(lease_s, 0.0), MAX_LEASE_S)
        return True

    def end(self, by: str) -> None:
        """Its holder does not want it any more."""
        self._until_s.pop(by, None)

    def expire(self, now_s: float) -> None:
        """End those whose time is over."""
        for by in [by for by, until_s in self._until_s.items() if until_s <= now_s]:
            del self._until_s[by]
