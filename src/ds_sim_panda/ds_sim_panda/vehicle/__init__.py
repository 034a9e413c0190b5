# SPDX-License-Identifier: Apache-2.0
"""Motion of the third sibling: a published multi-body model."""
