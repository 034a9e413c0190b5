# SPDX-License-Identifier: Apache-2.0
"""Digital sibling `torcs`: the car and the renderer of TORCS, in a process of its own."""
