# SPDX-License-Identifier: Apache-2.0
"""Verbs that predict a car, or a simulator that was never driven."""
