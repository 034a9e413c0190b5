"""First digital sibling: a rigid-body car on PyBullet."""
