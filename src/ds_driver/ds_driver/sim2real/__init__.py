# SPDX-License-Identifier: Apache-2.0
"""Pseudo-real images: generators that make a simulator's images look like photographs of a real track (paper 3.2.2)."""
