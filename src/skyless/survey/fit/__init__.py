"""Fitting positions and delays to ranges of pairs.

In the order of reading: ``problem`` (unknowns, rows, least squares).

Public: none.
"""
