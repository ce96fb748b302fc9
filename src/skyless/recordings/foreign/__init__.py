"""Recordings of other systems: their formats as streams of packets or time differences.

Public: avalue, bitcraze, fira, formats.
Within the package: anchor_frame, phones, tdoa_tables.
"""
