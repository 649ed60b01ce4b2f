"""What a person at a bench looks at: the facts of a bus or a log, as a page and in a terminal.

It may import ``core``, ``values``, ``dbc_files``, ``wire``, ``logs``, ``bus`` and ``recordings``.
"""
