"""Logs of a bus: files to read frame by frame or as arrays, to write, and as signals of any DBC.

It may import ``core``, ``values``, ``dbc_files`` and ``wire``.
"""
