"""Ranges of pairs of anchors from their stamps.

In the order of reading: ``legs`` (what a listener of beacons learns of anchors' receptions), ``brackets`` (times of
flight of a block of legs), ``clusters`` (which blocks of a pair agree), ``pair_ranger`` (ranges as legs arrive),
``steps`` (the same in the order of time); ``repeats`` (ranges that were measured otherwise).

Public: legs, pair_ranger, repeats, steps.
"""
