"""Why tests failed, from their own records."""
