"""Names of the positioning methods."""

from typing import Final

SNAPSHOTS: Final = ("literal", "literal-delayed", "weighted", "bracketed")
FILTERS: Final = ("joint",)
METHODS: Final = (*SNAPSHOTS, *FILTERS)

WEIGHTED: Final = "weighted"
"""The one that is always there and needs no estimator."""
DEFAULT_METHOD: Final = "joint"
PROTECTED: Final = "joint"
"""The one whose fixes have protection levels."""
