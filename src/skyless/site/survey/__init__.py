"""Positions and antenna delays of anchors from what they receive of one another."""
