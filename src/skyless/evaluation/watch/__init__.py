"""The watch of the anchors, tried: on drawn ranges and through simulated air.

Public: air, drawn.
"""
