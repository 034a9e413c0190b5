# SPDX-License-Identifier: Apache-2.0
"""Driving data: data sets, their collection in simulation, and recordings of real cars."""
