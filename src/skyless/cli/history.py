"""``skyless history``: what happened at a site, kept in Parquet files."""

from cyclopts import App

app = App(name="history", help_epilogue="Example: skyless history run --to history")
