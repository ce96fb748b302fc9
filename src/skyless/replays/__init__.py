"""Recordings through the filter again, judged against the truth.

Public: captures, plot, site.
Within the package: antenna_delays.
"""
