"""The one estimator: motion, clocks and range errors of all anchors in one Kalman filter (``docs/maths.md`` 6).

settings    what it assumes of tag, clocks, stamps, survey and ranges
state       what it keeps, by name; anchors join and leave; its arrays as bytes and back, checked
kalman      time update and the scalar measurement update
faults      range errors that the state does not hold: what they do to it, and taking them into it
monitor     which measurements are used, and how process noise follows what is seen
kinds       the kinds of measurements, each with its Jacobian
flatness    whether the anchors determine the height
levels      protection levels
estimator   packet by packet, or many in one loop
"""
