"""Command line `ds`."""
