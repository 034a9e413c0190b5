# SPDX-License-Identifier: Apache-2.0
"""Searches for roads that make a driver fail (paper 3.3), with an ask/tell interface."""
