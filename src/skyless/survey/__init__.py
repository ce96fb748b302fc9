"""Positions and antenna delays of anchors from what they receive of one another.

``ranges`` and ``facts`` go in, ``solve`` makes a ``result`` of them: ``build`` (equations), ``shape`` (fit and
covariance), ``frame`` (origin and axes), ``findings`` (what is not determined), ``kept`` (delays only). ``fit/``
computes, ``stamps/`` makes ranges of stamps.

Public: facts, ranges, result.
"""
