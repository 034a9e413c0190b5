# SPDX-License-Identifier: Apache-2.0
"""Sets the project up on a bare machine; needs only the standard library of the system's Python."""
