"""The verbs of `ds`, a module for each kind of thing that they are about."""
