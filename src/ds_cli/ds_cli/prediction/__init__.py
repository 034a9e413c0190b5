"""Verbs that predict a car, or a simulator that was never driven."""
