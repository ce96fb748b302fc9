"""That a survey knows of tags: a base without arrays, so that programs that only carry facts need no NumPy."""

from msgspec import Struct


class TagReceived(Struct, frozen=True, eq=False):
    """What a tag received of the anchors; always a ``TagEpochs``."""
