"""Make ``skyless_core.h`` and ``skyless_core.c`` from the Python that boards and browsers share with it.

python tools/make_core.py
"""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from skyless.core.air import beacon, neighbours
from skyless.core.estimator import kalman, levels, process, state, steady_state
from skyless.core.native import arithmetic
from skyless.core.tag import admission, following, hearing, position
from translator.files import translate

EXPORTS: Final[tuple[Callable[..., Any], ...]] = (
    beacon.read_frame,
    neighbours.unwrap_stamp,
    admission.admit_sender,
    admission.admit_stamp,
    hearing.begin_tag,
    hearing.begin_here,
    hearing.wake,
    hearing.hear_frame,
    hearing.hear_fields,
    state.restart,
    state.add_anchor,
    state.find_anchor,
    levels.fit_plane,
    process.leave,
    process.process_frame,
    process.process_difference,
    process.process_height,
    process.track,
    steady_state.find_steady_state,
    steady_state.find_walked,
    steady_state.process_known,
    position.find_position,
    following.begin_course,
    following.begin_again,
    following.follow,
)
"""What is called from outside."""

BY_HAND: Final = (kalman.compute_ph, kalman.compute_fault_input, kalman._inform, kalman._apply_updates)
"""What a target may have by hand, in the file that ``SKYLESS_BY_HAND`` names."""

NAME: Final = "skyless_core"
FOLDER: Final = Path(inspect.getfile(arithmetic)).parent

if __name__ == "__main__":
    for text, suffix in zip(translate(EXPORTS, NAME, BY_HAND), ("h", "c"), strict=True):
        (FOLDER / f"{NAME}.{suffix}").write_text(text)
