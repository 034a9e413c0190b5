# SPDX-License-Identifier: Apache-2.0
"""Tables, charts and statistics that several analyses share."""
