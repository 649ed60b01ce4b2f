"""Consumers of received lines: what a car does with them."""
