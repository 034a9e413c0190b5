from .autopilot import Autopilot, throttle
from .speed_controller import SpeedController
from .stamp_matching import StampMatcher

__all__ = ["Autopilot", "SpeedController", "StampMatcher", "throttle"]
