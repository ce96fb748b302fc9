"""Tags in a simulated site, and their errors against the truth.

Public: anchor_stamps, cell_fleet, claim_graphs, compile_ahead, figures, fleet, fleet_run, judge, observability,
report_page, scenarios, statistics.
"""
