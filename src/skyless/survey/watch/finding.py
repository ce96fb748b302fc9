"""What the watch has found."""

from typing import Final, Literal

from msgspec import Struct

Kind = Literal["moved", "delay", "link", "check"]


class Finding(Struct, frozen=True):
    """Something at the anchors has changed."""

    kind: Kind
    """An anchor has moved; its delay has changed; one link is blocked; something has changed, unclear what."""
    anchors: tuple[int, ...]
    """The anchor, or both ends of the link; for ``check`` those in question, in ascending order."""
    size_m: float
    """How far it has moved, or by how much its delay h or the link's range has grown; 0 for a link that is silent."""
    std_m: float | None
    since_s: float
    """When the first window in which it was seen began, on the clock of the blocks."""
    sentence: str


_SILENT: Final = "anchors {} and {} no longer receive each other"


def silent_link(a: int, b: int, since_s: float) -> Finding:
    """A pair without ranges while both anchors have them with others."""
    return Finding("link", (a, b), 0.0, None, since_s, _SILENT.format(a, b))


def sentence_of(kind: Kind, anchors: tuple[int, ...], size_m: float, *, or_else: Kind | None = None) -> str:
    """One sentence without a full stop. ``or_else``: what the same anchor may have done as well."""
    if kind == "moved":
        sentence = f"anchor {anchors[0]} has moved by about {_length(size_m)}"
        return f"{sentence}, or its delay has changed" if or_else else sentence
    if kind == "delay":
        more = "more" if size_m > 0.0 else "less"
        sentence = f"the delay of anchor {anchors[0]} has changed: {_length(abs(size_m))} {more}"
        return f"{sentence}, or it has moved" if or_else else sentence
    if kind == "link":
        a, b = anchors
        if size_m < 0.0:
            return f"the link between {a} and {b} is {_length(-size_m)} shorter: it was blocked before"
        return f"the link between {a} and {b} is blocked: {_length(size_m)} late"
    if len(anchors) == 1:
        return f"something has changed at anchor {anchors[0]}: check"
    *others, last = map(str, anchors)
    return f"something has changed at anchors {', '.join(others)} or {last}: check"


def _length(size_m: float) -> str:
    return f"{size_m:.1f} m" if size_m >= 0.995 else f"{max(round(100.0 * size_m), 1)} cm"
