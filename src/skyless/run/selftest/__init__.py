"""``skyless selftest``: one or two boards in front of a person, before there is a site.

Public: facts, measure.
"""
