"""Recordings of a running site and of other systems; tables of anchors, ranges and true positions.

Public: anchor_table, range_table, source, truth.
"""
