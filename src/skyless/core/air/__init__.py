"""Beacons, the almanac and their bytes, and what a radio reports of a frame."""
