"""Sensors: recorded values from light."""
