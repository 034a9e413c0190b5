# SPDX-License-Identifier: Apache-2.0
"""What a sibling adds: failures against road features, and against other siblings' failures."""
