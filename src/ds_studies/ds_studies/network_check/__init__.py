# SPDX-License-Identifier: Apache-2.0
"""Checks how a network is connected: what it sees, and whether it steers as the autopilot does."""
