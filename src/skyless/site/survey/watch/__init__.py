"""Anchors that moved, or changed otherwise, since their survey."""
