# SPDX-License-Identifier: Apache-2.0
"""Gates of a test: whether a failure on it says anything about the network."""
