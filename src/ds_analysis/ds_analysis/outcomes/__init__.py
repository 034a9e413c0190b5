# SPDX-License-Identifier: Apache-2.0
"""Outcomes that came from elsewhere: any simulators' and cars' verdicts on the same tests, read from tables."""
