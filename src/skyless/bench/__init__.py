"""How fast the program is on this machine.

Public: measure, monte_carlo_speed.
Within the package: baselines, runs.
"""
