"""Predicted errors and reception, and optimal positions of anchors."""
