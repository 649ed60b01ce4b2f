"""Drives of a car, their sensors and their truth."""
