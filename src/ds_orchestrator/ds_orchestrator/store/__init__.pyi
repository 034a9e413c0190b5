from .model import Execution, Test
from .sqlite_file import StoreError
from .store import Store

__all__ = ["Execution", "Store", "StoreError", "Test"]
