"""Store of a campaign: one SQLite file."""
