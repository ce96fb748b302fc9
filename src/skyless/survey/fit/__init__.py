"""Fitting positions and delays to ranges of pairs.

In the order of reading: ``problem`` (unknowns, rows, least squares), ``links`` (counting), ``start``, ``robust`` and
``neighbours`` (a fit that late ranges do not spoil), ``ambiguity`` and ``presence`` (other results), ``determined``
(covariance), ``tapes``, ``gauge``.

Public: ambiguity, determined, gauge, links, problem, robust, start, tapes.
"""
