# SPDX-License-Identifier: Apache-2.0
"""Why a test fails on one simulator and not on another, by experiment."""
