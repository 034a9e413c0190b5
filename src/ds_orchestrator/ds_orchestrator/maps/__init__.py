# SPDX-License-Identifier: Apache-2.0
"""Feature maps: pooling, union and merge (paper 3.3 to 3.5)."""
