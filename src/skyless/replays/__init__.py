"""Recordings through the filter again, judged against the truth.

Public: capture_run, captures, inputs, plot, site.
Within the package: antenna_delays.
"""
