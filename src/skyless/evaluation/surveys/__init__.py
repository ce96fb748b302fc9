"""Surveys of anchors through simulated air, judged against the truth.

In the order of reading: ``layouts`` (sites), ``air`` (one run, with errors that are drawn), ``judge`` (a survey against
the truth and its bound); ``rooms`` (one room, and the site files that different people would write for it).

Public: air, judge, layouts, rooms.
"""
