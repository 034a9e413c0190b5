# SPDX-License-Identifier: Apache-2.0
"""The digital twin: a 1:16 Donkey Car with its actuators, camera and delays."""
