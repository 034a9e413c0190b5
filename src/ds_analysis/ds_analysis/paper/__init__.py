# SPDX-License-Identifier: Apache-2.0
"""Evaluation: the siblings' maps against the twin's, and steering errors without driving (paper 4.3)."""
