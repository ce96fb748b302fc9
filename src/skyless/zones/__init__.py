"""Zones: polygons on the floor, and which tags are in them.

Public: monitor, zone_list.
Within the package: polygon.
"""
