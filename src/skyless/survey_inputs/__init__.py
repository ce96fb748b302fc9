"""Antenna delays from a recording of a tag whose position is known.

Public: estimate, run, samples.
"""
