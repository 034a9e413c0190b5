"""A campaign's results as Parquet files, for pandas, Polars, DuckDB, Spark and whatever else reads them."""
