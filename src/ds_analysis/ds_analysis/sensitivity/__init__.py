# SPDX-License-Identifier: Apache-2.0
"""Results of a sensitivity analysis: conditions that were varied, and the strength at which a driver fails."""
