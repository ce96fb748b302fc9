"""Make C from Python: ``skyless_core``, which boards and browsers share, and ``skyless_kernels`` of the simulation.

python tools/make_core.py
"""

from collections.abc import Callable
from typing import Any, Final

from skyless.core.air import beacon, neighbours
from skyless.core.estimator import kalman, levels, motion, process, state, steady_state
from skyless.core.native.library import CORE, FOLDER, KERNELS
from skyless.core.tag import admission, following, hearing, position
from skyless.research import benchmark
from skyless.sim import listening, oscillator
from skyless.site.planning import links, optimise, rates
from translator.files import translate

EXPORTS: Final[tuple[Callable[..., Any], ...]] = (
    beacon.read_frame,
    neighbours.unwrap_stamp,
    admission.admit_sender,
    admission.admit_stamp,
    hearing.begin_tag,
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
    motion.hear_motion,
    motion.hear_wheels,
    process.track,
    steady_state.find_steady_state,
    steady_state.find_walked,
    steady_state.process_known,
    position.find_position,
    following.begin_course,
    following.begin_again,
    following.follow,
)
"""What is called from outside of the core."""

KERNEL_EXPORTS: Final[tuple[Callable[..., Any], ...]] = (
    oscillator.advance,
    oscillator.foresee,
    oscillator.emit,
    listening.receive_frame,
    links.fill_links,
    rates.fill_rates,
    optimise.judge,
    benchmark.run_plain,
)

BY_HAND: Final = (kalman.compute_ph, kalman.compute_fault_input, kalman._inform, kalman._apply_updates)
"""What a target may have by hand, in the file that ``SKYLESS_BY_HAND`` names."""

FILES: Final = ((CORE, EXPORTS, BY_HAND), (KERNELS, KERNEL_EXPORTS, ()))

if __name__ == "__main__":
    for name, exports, by_hand in FILES:
        for text, suffix in zip(translate(exports, name, by_hand), ("h", "c"), strict=True):
            (FOLDER / f"{name}.{suffix}").write_text(text)
