# SPDX-License-Identifier: Apache-2.0
"""Store of a campaign: one SQLite file."""
