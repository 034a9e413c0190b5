# SPDX-License-Identifier: Apache-2.0
"""`ds bag`: recorded runs."""
