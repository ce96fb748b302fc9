"""Recordings of a running site and of other systems; tables of anchors and of true positions.

Public: anchor_table, source, truth.
"""
