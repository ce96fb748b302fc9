"""Positioning from packets of anchors without a common time."""
