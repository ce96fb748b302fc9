"""Positions and antenna delays of anchors from what they receive of one another.

``ranges`` and ``facts`` go in, ``result`` comes out; ``fit/`` computes, ``stamps/`` makes ranges of stamps.

Public: facts, ranges, result.
"""
