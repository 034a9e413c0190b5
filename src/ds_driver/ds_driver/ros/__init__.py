"""The nodes that drive."""
