"""Fitting positions and delays to ranges of pairs.

In the order of reading: ``problem`` (unknowns, rows, least squares), ``start`` (where a fit begins), ``neighbours``
(other results close to one), ``presence`` (which pairs have a range), ``robust`` (late ranges left out), ``ambiguity``
(whether another result fits as well).

Public: none.
"""
