# SPDX-License-Identifier: Apache-2.0
"""Engines that drive a campaign's roads without ROS: on this machine, or on a Dask cluster."""
