from .ground import Ground, paint_ground
from .look import Look
from .projection import project
from .renderer import Camera
from .sensor import Sensor
from .spec import CameraSpec

__all__ = ["Camera", "CameraSpec", "Ground", "Look", "Sensor", "paint_ground", "project"]
