# SPDX-License-Identifier: Apache-2.0
"""Drives of a network on the tests of another, and what they show."""
