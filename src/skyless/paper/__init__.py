"""The paper's figures and claims, reproduced in one report.

Public: monte_carlo, plan, run.
Within the package: checks, claim, distributions, dop_map, html, listening, rate, scale, scenario, static, timeline,
walk.
"""
