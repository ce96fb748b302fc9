"""How well positions are known: geometry (DOPs), propagated covariances, bounds.

Public: bounds, chain, dop, ellipse.
"""
