"""Rounding errors of production lane messages."""
