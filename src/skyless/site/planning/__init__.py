"""Predicted errors, ranges and places of anchors."""
