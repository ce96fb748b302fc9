"""The history of a site: fixes and events in Parquet files, and queries on them."""
