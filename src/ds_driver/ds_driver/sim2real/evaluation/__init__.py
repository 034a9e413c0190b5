"""Assessment of generators by numbers: lane, steering, distance to photographs, flicker."""
