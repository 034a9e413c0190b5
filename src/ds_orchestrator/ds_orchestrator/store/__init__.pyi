from .sqlite_file import StoreError
from .store import Execution, Store, Test

__all__ = ["Execution", "Store", "StoreError", "Test"]
