"""The history of a site: fixes and events in Parquet files, and what is asked of them."""
