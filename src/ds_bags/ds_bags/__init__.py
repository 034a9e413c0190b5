# SPDX-License-Identifier: Apache-2.0
"""rosbag2 folders: written, read, verified, recovered and packed, with and without ROS.

Public names are imported when they are first used; `__init__.pyi` lists them.
"""

from ds_base.lazy_names import names_of_stub

__getattr__, __dir__, __all__ = names_of_stub(__name__, __file__)
