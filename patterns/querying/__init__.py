"""MATCH_RECOGNIZE as a query over any Arrow table, among SQL that DuckDB runs."""
