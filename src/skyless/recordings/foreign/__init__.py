"""Recordings of other systems: their formats as streams of packets or time differences.

Public: avalue, bitcraze, formats.
Within the package: tdoa_tables.
"""
