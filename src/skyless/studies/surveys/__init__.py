"""The study ``survey``: anchors that survey themselves through simulated air.

In the order of reading: ``cases`` (what varies), ``air`` (one run), ``judge`` (a survey against the truth), ``study``
(runs and rows).

Public: study.
"""
