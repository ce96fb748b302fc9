"""Tags in a simulated site, and their errors against the truth.

Public: adversary, anchor_stamps, attacked_air, cell_fleet, claim_graphs, compile_ahead, figures, fleet, fleet_run, judge, observability,
report_page, scenarios, statistics.
"""
