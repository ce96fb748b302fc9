"""Lists of anchors in sentences."""

from collections.abc import Iterable, Sequence


def joined(names: Iterable[object]) -> str:
    """1, 2 and 3."""
    texts = [str(name) for name in names]
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}" if texts else "none"


def anchors_named(anchors: Sequence[int]) -> str:
    """``anchor 1``, ``anchors 1 and 2``."""
    return f"anchor{'s' if len(anchors) != 1 else ''} {joined(anchors)}"


def are(anchors: Sequence[int]) -> str:
    """The verb that goes with them."""
    return "is" if len(anchors) == 1 else "are"


def distances_named(pairs: Sequence[tuple[int, int]]) -> str:
    """``the distance between 1 and 5``, ``the distances 1–5 and 2–4``."""
    if len(pairs) == 1:
        return f"the distance between {pairs[0][0]} and {pairs[0][1]}"
    return f"the distances {joined(f'{a}–{b}' for a, b in pairs)}"
