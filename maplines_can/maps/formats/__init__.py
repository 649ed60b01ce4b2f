"""Formats of map files.

It may import ``values`` and ``maps``.
"""
