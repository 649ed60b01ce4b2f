"""The messages of a DBC: signals, records, what they must have.

It may import ``core``, ``values`` and ``dbc_files``.
"""
