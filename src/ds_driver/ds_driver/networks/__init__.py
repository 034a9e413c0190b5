# SPDX-License-Identifier: Apache-2.0
"""Driving networks: architectures, weights, inference backends, and user-provided networks."""
