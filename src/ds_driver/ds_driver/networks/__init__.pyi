from .architectures import UnknownNetworkError
from .backends import BackendError
from .network_driver import NetworkDriver, load_pilot
from .pilot import DriverError, Frame, Pilot, Prediction
from .preprocessing import Crop, ImageError, prepare
from .torch_networks import make_network
from .weights import WeightsError, shipped_networks

__all__ = [
    "BackendError",
    "Crop",
    "DriverError",
    "Frame",
    "ImageError",
    "NetworkDriver",
    "Pilot",
    "Prediction",
    "UnknownNetworkError",
    "WeightsError",
    "load_pilot",
    "make_network",
    "prepare",
    "shipped_networks",
]
