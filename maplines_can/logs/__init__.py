"""Logs of a bus: files to read frame by frame or as arrays, to write, and as signals of any DBC."""
