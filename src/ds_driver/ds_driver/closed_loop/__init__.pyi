from .simulation import AUTOPILOT, drive_road, make_driver
from .success_rate import success_rates

__all__ = ["AUTOPILOT", "drive_road", "make_driver", "success_rates"]
