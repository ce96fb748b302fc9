"""Numeric code that is compiled by Numba: arrays, linear algebra, and how compiled code is kept."""
