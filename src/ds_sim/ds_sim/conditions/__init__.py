# SPDX-License-Identifier: Apache-2.0
"""Operating conditions of a test beside its road: paint, light, weather, surface, camera, sensor and vehicle."""
