"""Generated code: a DBC as constant C tables, the C core, and vectors for other receivers.

It may import ``core``, ``values``, ``propagation`` and ``wire``.
"""
