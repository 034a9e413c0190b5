# SPDX-License-Identifier: Apache-2.0
"""Regression suites: the tests of a campaign that tell most, frozen in a file with their outcomes."""
