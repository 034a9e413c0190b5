# SPDX-License-Identifier: Apache-2.0
"""Recordings of a real car as siblings: where the car was, on which track, seen by which camera."""
