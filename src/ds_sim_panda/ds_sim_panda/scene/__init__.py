# SPDX-License-Identifier: Apache-2.0
"""World and camera of the simulator `panda`, drawn by Panda3D."""
