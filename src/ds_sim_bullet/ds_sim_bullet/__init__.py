"""First digital sibling: a rigid-body car in PyBullet."""
