# SPDX-License-Identifier: Apache-2.0
"""Foundation without a word of the domain: errors, safe files, bounded YAML, trust, processes."""

from ds_base.errors import DsError, InputError, RunError
from ds_base.folder_files import LockError, StoreError, locked

__all__ = ["DsError", "InputError", "LockError", "RunError", "StoreError", "locked"]
