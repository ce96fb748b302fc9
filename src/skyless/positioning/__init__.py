"""From receptions to positions: the values that all methods share; methods, estimator and masterless sites below.

Public: alert, fix, integrity, observation.
"""
