"""The functions of the library: what Python, boards and browsers call."""

from collections.abc import Callable
from typing import Any, Final

from skyless.core.estimator import levels, process, state, steady_state

EXPORTS: Final[tuple[Callable[..., Any], ...]] = (
    state.prepare,
    state.add_anchor,
    state.remove_anchor,
    state.find_anchor,
    levels.fit_plane,
    process.process_frame,
    process.process_difference,
    process.process_height,
    process.track,
    steady_state.find_steady_state,
    steady_state.process_known,
)
