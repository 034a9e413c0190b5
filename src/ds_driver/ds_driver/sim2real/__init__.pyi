from .generator_file import StoredGenerator, load_generator
from .preparation import Prepared, prepare_domains
from .settings import PRESETS, Sim2RealSettings
from .trainer import train
from .translator import Translator
from .window import Sim2RealError, Window

__all__ = [
    "PRESETS",
    "Prepared",
    "Sim2RealError",
    "Sim2RealSettings",
    "StoredGenerator",
    "Translator",
    "Window",
    "load_generator",
    "prepare_domains",
    "train",
]
