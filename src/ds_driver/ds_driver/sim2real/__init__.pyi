from .generator_file import StoredGenerator, load_generator
from .preparation import Sources, prepare_domains, read_sources
from .settings import PRESETS, Sim2RealSettings
from .trainer import train
from .translator import Translator
from .window import Sim2RealError, Window

__all__ = [
    "PRESETS",
    "Sim2RealError",
    "Sim2RealSettings",
    "Sources",
    "StoredGenerator",
    "Translator",
    "Window",
    "load_generator",
    "prepare_domains",
    "read_sources",
    "train",
]
