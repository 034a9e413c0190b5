"""Driving data: data sets, their collection in simulation, and recordings of real cars."""
