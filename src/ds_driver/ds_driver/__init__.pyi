# SPDX-License-Identifier: Apache-2.0
from .closed_loop.simulation import drive_road, make_driver
from .control.autopilot import Autopilot, throttle
from .control.other_stacks import SpeedController, StampMatcher
from .data.collection import CollectionPlan, collect
from .data.dataset import DatasetError, Sample, read_samples
from .data.recordings import Reading, RecordedFrame, Recording, open_recording
from .networks.architectures import UnknownNetworkError
from .networks.backends import BackendError
from .networks.driver_name import AUTOPILOT, DriverName
from .networks.images import Crop, ImageError, prepare
from .networks.network_driver import NetworkDriver, load_pilot
from .networks.pilot import DriverError, Frame, Pilot, Prediction
from .networks.torch_networks import make_network
from .networks.weights import WeightsError, shipped_networks
from .sim2real.generator import Sim2RealError, StoredGenerator, Window, load_generator
from .sim2real.image_translation import Translator
from .sim2real.preparation import Sources, make_domains, prepare_domains, read_sources
from .sim2real.settings import PRESETS, Sim2RealSettings
from .training import TrainingError, TrainingPlan, train

__all__ = [
    "AUTOPILOT",
    "Autopilot",
    "BackendError",
    "CollectionPlan",
    "Crop",
    "DatasetError",
    "DriverError",
    "DriverName",
    "Frame",
    "ImageError",
    "NetworkDriver",
    "PRESETS",
    "Pilot",
    "Prediction",
    "Reading",
    "RecordedFrame",
    "Recording",
    "Sample",
    "Sim2RealError",
    "Sim2RealSettings",
    "Sources",
    "SpeedController",
    "StampMatcher",
    "StoredGenerator",
    "TrainingError",
    "TrainingPlan",
    "Translator",
    "UnknownNetworkError",
    "WeightsError",
    "Window",
    "collect",
    "drive_road",
    "load_generator",
    "load_pilot",
    "make_driver",
    "make_domains",
    "make_network",
    "open_recording",
    "prepare",
    "prepare_domains",
    "read_samples",
    "read_sources",
    "shipped_networks",
    "throttle",
    "train",
]
