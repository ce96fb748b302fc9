"""Tags in a simulated site, and their errors against the truth.

Public: cell_fleet, compile_ahead, figures, fleet, judge, observability, report_page, scenarios,
statistics.
"""
