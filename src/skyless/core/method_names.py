"""Names of the positioning methods, and of kinds of motion."""

from typing import Final, Literal

SNAPSHOTS: Final = ("literal", "literal-delayed", "weighted", "bracketed")
FILTERS: Final = ("joint",)
METHODS: Final = (*SNAPSHOTS, *FILTERS)

WEIGHTED: Final = "weighted"
"""The method that is always available and needs no estimator."""
DEFAULT_METHOD: Final = "joint"
PROTECTED: Final = "joint"
"""The method whose fixes have protection levels."""

Dynamics = Literal["walk", "robot", "drone"]
"""How tags move: as people, as robots at some 5 m/s, as drones at some 10 m/s."""
DYNAMICS_QA_M2PS3: Final[dict[str, float]] = {"walk": 0.3, "robot": 1.0, "drone": 3.0}
"""Process noise assumed for each kind of motion."""
