"""Names of the positioning methods."""

from typing import Final

SNAPSHOTS: Final = ("literal", "literal-delayed", "weighted", "bracketed")
FILTERS: Final = ("joint",)
METHODS: Final = (*SNAPSHOTS, *FILTERS)

DEFAULT_METHOD: Final = "joint"
PROTECTED: Final = "joint"
"""The one whose fixes have protection levels."""
