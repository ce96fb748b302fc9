"""Tags in a simulated site, and their errors against the truth."""
