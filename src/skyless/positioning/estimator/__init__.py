"""The one estimator: motion, clocks and range errors of all anchors in one Kalman filter (``docs/maths.md`` 6).

settings    what it assumes of tag, clocks, stamps, survey and ranges
state       what it keeps, by name; anchors join and leave
kalman      time update, the scalar measurement update, and what undetected faults do to the state
monitor     which measurements are used, and how process noise follows what is seen
kinds       the kinds of measurements, each with its Jacobian
levels      protection levels
estimator   packet by packet, or many in one loop
"""
