"""Recordings of other systems: their formats as streams of packets or time differences.

Public: anchor_frame, avalue, bitcraze, fira, formats.
Within the package: phones, tdoa_tables.
"""
