# SPDX-License-Identifier: Apache-2.0
"""Page that shows a campaign while it runs, or after it."""
