"""Names of the positioning methods."""

from typing import Final

SNAPSHOTS: Final = ("literal", "literal-delayed", "weighted", "bracketed")
FILTERS: Final = ("joint",)
METHODS: Final = (*SNAPSHOTS, *FILTERS)

WEIGHTED: Final = "weighted"
"""The method that is always available and needs no estimator."""
DEFAULT_METHOD: Final = "joint"
PROTECTED: Final = "joint"
"""The method whose fixes have protection levels."""
