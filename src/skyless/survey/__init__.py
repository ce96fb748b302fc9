"""Positions and antenna delays of anchors from what they receive of one another.

``ranges`` and ``facts`` go in, ``result`` comes out; ``fit/`` computes, ``stamps/`` makes ranges of stamps. A
result goes into a site by ``surveyed_site``; ``record`` is what is kept of a survey next to the site's file.

Public: count, facts, ranges, record, repeats, result, solve, surveyed_site.
"""
