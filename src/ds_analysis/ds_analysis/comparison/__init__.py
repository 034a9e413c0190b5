"""Two networks on the same tests: paired outcomes per simulator and per cell, pass criteria, summaries."""
