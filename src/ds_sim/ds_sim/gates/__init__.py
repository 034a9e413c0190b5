"""Gates of a test: whether a failure on it says anything about the network."""
