"""Drivers: the reference autopilot, the networks, their training data and training, and the nodes that run them."""
