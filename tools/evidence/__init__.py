"""Evidence for the promises of docs/promises.md: one module for each kind.

A function with the decorator ``evidence`` takes options and returns figures by name. The command
line, the progress, the tables and the bounds are those of the harness; the bounds, with the
promises, are in ``bounds.toml``.
"""
