# SPDX-License-Identifier: Apache-2.0
"""Second digital sibling: a car of nodes and damped beams in pymunk."""
