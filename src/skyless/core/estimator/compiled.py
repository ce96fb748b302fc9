"""The estimator's functions as compiled in the library."""

from skyless.core.estimator import levels, motion, process, state
from skyless.core.native.library import compiled

add_anchor = compiled(state.add_anchor)
restart = compiled(state.restart)
find_anchor = compiled(state.find_anchor)
fit_plane = compiled(levels.fit_plane)
leave = compiled(process.leave)
process_frame = compiled(process.process_frame)
process_difference = compiled(process.process_difference)
hear_motion = compiled(motion.hear_motion)
hear_wheels = compiled(motion.hear_wheels)
process_height = compiled(process.process_height)
track = compiled(process.track)
