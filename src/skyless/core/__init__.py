"""What a tag and an anchor compute: beacons, keys, the estimator, receivers. No I/O, no clock, no simulation."""
