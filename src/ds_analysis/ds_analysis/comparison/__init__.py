# SPDX-License-Identifier: Apache-2.0
"""Two networks on the same tests: paired outcomes per simulator and per cell, pass criteria, summaries."""
