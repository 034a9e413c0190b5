# SPDX-License-Identifier: Apache-2.0
"""Server of the Donkey simulator's protocol, so that its clients drive on any simulator of the registry.

JSON objects over TCP, as in `sdsandbox`, the source of the Donkey simulator, and in its client gym-donkeycar 1.3.1. The
one difference is lock-step: the Donkey simulator sends telemetry at 20 Hz whatever the client does; this server sends
one telemetry for each control, so that a run depends on the controls alone, never on how fast either side is.
"""
