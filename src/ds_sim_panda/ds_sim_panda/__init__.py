# SPDX-License-Identifier: Apache-2.0
"""Third digital sibling: a multi-body car in a world rendered by Panda3D."""
