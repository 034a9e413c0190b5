"""Second digital sibling: a car of nodes and damped beams in pymunk."""
