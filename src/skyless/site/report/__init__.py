"""Drawing of reports."""
