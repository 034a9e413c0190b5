"""`ds bag`: recorded runs."""
