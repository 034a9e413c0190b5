# SPDX-License-Identifier: Apache-2.0
"""Search, campaign, store, bags, feature maps, evaluation, report and command line.

Public names are imported when they are first used; `__init__.pyi` lists them.
"""

from ds_base.lazy_names import names_of_stub

__getattr__, __dir__, __all__ = names_of_stub(__name__, __file__)
