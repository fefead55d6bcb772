"""Stochastic model of a sensor at rest."""
