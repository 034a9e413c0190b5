# SPDX-License-Identifier: Apache-2.0
"""Campaigns: configuration, folder, and the stages that drive."""
