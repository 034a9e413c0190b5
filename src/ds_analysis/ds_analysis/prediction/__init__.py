# SPDX-License-Identifier: Apache-2.0
"""Predicts failures on a simulator, or a car, that few or no tests were driven on, beside its baselines."""
