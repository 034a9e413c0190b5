# SPDX-License-Identifier: Apache-2.0
"""Verbs of `ds` about campaigns and suites."""
