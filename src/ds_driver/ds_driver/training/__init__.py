"""Training of driving networks (paper 3.2.2)."""
