"""Checks how a network is connected: what it sees, and whether it steers as the autopilot does."""
