"""Recordings of a bus: logs as arrays of frames and of lines, tables, plots.

It may import ``core``, ``values``, ``wire``, ``logs``, ``bus`` and ``engines``.
"""
