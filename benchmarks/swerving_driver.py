"""A driver that leaves the lane within seconds: campaigns with short drives, for tests of everything around them."""

from __future__ import annotations

from ds_driver.networks.pilot import Frame


class Swerving:
    """Steers to the right, by how bright the road ahead is: what it does depends on the image, bit by bit."""

    def drive(self, seen: Frame) -> float:
        """Steering for an image, between 0 and 0.5."""
        return float(seen.image[80:].mean()) / 510.0
