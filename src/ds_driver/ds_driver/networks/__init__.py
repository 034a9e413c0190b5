"""Driving networks: architectures, weights, inference backends, and user-provided networks."""
