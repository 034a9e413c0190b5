# SPDX-License-Identifier: Apache-2.0
"""A small budget of drives on a real car: which to drive, how outcomes are kept, and what they change."""
