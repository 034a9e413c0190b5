"""Verbs that drive because an analysis asks for it."""
