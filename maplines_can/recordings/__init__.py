"""Recordings of a bus: logs as arrays of frames and of lines, tables, plots."""
