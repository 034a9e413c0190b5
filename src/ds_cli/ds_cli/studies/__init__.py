# SPDX-License-Identifier: Apache-2.0
"""Verbs that drive because an analysis asks for it."""
