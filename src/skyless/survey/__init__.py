"""Positions and antenna delays of anchors from what they receive of one another.

``ranges`` and ``facts`` go in, ``solve`` makes a ``result`` of them: ``build`` (equations), ``shape`` (fit and
covariance), ``tagged`` (what tags add), ``frame`` (origin and axes), ``findings`` (what is not determined), ``kept``
(delays only). ``fit/`` computes, ``stamps/`` makes ranges of stamps, ``tags/`` rows of a tag's receptions. A result
goes into a site by ``surveyed_site``; ``record`` is what is kept of a survey next to the site's file.

Public: count, facts, ranges, record, result, solve, surveyed_site.
"""
