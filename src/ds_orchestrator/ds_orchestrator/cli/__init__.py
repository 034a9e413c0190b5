"""The command line `ds`."""
