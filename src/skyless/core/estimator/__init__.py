"""The one estimator: motion, clocks and range errors of all anchors in one Kalman filter (``docs/maths.md`` 6)."""
