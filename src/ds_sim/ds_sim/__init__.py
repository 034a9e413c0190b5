# SPDX-License-Identifier: Apache-2.0
"""Simulator interface, the parts that all simulators share, and the ROS node that hosts any of them.

Public names are imported on first use; `__init__.pyi` lists them.
"""

from ds_base.lazy_names import names_of_stub

__getattr__, __dir__, __all__ = names_of_stub(__name__, __file__)
