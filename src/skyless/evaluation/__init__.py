"""Tags in a simulated site, and their errors against the truth.

Public: compile_ahead, figures, fleet, judge, observability, report_page, scenarios, statistics.
"""
