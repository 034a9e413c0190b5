"""Verbs of `ds` about campaigns and suites."""
