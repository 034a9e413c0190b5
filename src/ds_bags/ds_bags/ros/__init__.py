"""Bags on a live graph: images recorded from it, and bags published to it."""
