"""The one estimator: motion, clocks and range errors of all anchors in one Kalman filter (``docs/maths.md`` 6).

state         what it assumes of tag, clocks, stamps, survey and ranges; what it keeps, by name; anchors join and leave
kalman        time update and the scalar measurement update
faults        range errors that the state does not hold: what they do to it, and adding them to it
monitor       which measurements are used, and how process noise is adapted to innovations
measurements  the kinds of measurements, each with its Jacobian
levels        protection levels, and whether they can be relied on
estimator     packet by packet, or many in one loop; saved and restored

Public: estimator, faults, kalman, levels, measurements, monitor, state.
"""
