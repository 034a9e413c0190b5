# SPDX-License-Identifier: Apache-2.0
"""How strong each operating condition must be for a driver to fail, one condition at a time."""
