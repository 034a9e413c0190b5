"""Drives of a network on the tests of another, and what they show."""
