"""Positions and antenna delays of anchors from their receptions of one another."""
