# SPDX-License-Identifier: Apache-2.0
"""Why tests failed, from their own records."""
