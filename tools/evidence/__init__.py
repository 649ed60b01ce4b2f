"""Evidence for the promises of docs/promises.md: one module for each kind.

A function with the decorator ``evidence`` takes options and returns figures by name. The command
line, the progress and the tables are those of the harness; the promises, the bounds of the figures
and the options of the quickest form are rows of ``bounds.toml``. What a test shows, the row names.
"""
