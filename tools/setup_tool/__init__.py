"""Sets the project up on a bare machine: plain standard library, run by the system's own Python."""
