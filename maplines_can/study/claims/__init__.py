"""Accuracy of the representations of a line against its true distribution."""
