"""Runs as data sets for offline learning: episodes, and their files in Minari's and a plain Parquet form."""
