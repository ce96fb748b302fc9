"""Checks of a computer and its boards, for ``skyless doctor``."""
