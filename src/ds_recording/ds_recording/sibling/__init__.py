# SPDX-License-Identifier: Apache-2.0
"""A recording as a simulator: the fitted twin on the recorded track, seen in its photographs."""
