from .closed_loop.simulation import AUTOPILOT, drive_road, make_driver
from .closed_loop.success_rate import success_rates
from .control.autopilot import Autopilot
from .data.collection import CollectionPlan, collect
from .networks.network_driver import NetworkDriver, load_pilot
from .networks.pilot import DriverError, Frame, Pilot, Prediction
from .training.trainer import TrainingPlan, train

__all__ = [
    "AUTOPILOT",
    "Autopilot",
    "CollectionPlan",
    "DriverError",
    "Frame",
    "NetworkDriver",
    "Pilot",
    "Prediction",
    "TrainingPlan",
    "collect",
    "drive_road",
    "load_pilot",
    "make_driver",
    "success_rates",
    "train",
]
