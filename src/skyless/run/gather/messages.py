"""The messages of a gather in JSON (``docs/batches.md``)."""

from msgspec import Struct


class TagName(Struct, frozen=True):
    """The name of a tag's number. A number is given once and never again."""

    name: str
    host: str
    """Where its fixes are packed."""
    since_unix_s: float


class NumbersRequest(Struct, frozen=True):
    """A program that packs the fixes of its tags itself asks for their numbers."""

    names: tuple[str, ...]
    host: str


class Numbers(Struct, frozen=True):
    """The numbers of the tags in a request, in its order."""

    numbers: tuple[int, ...] = ()
    error: str | None = None


class Summary(Struct, frozen=True):
    """What a gather has done since its start, once a second."""

    unix_s: float
    host: str
    version: str
    site: str
    """Name of the site; empty until the site was published."""
    simulated: bool
    names: int
    """Tags that have a number."""
    online: dict[str, int]
    """Programs that are online, by kind."""
    fixes: int
    """Fixes taken from JSON."""
    packed: int
    """Fixes that came packed from other programs."""
    batches: int
    """Batches that the stream has acknowledged."""
    waiting: int
    """Fixes that are not in an acknowledged batch yet."""
    drops: dict[str, int]
    """Messages and fixes that were dropped, by reason."""
    cuts: int
    """How often the server ended the connection or was away."""
