"""Positioning from packets of anchors that have no common time."""
