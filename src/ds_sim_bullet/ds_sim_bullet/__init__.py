# SPDX-License-Identifier: Apache-2.0
"""First digital sibling: a rigid-body car in PyBullet."""
