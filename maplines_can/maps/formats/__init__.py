"""Formats of map files."""
