"""Generated files: the DBCs, a DBC as constant C tables, the C core, vectors for other receivers.

It may import ``core``, ``values``, ``propagation`` and ``wire``.
"""
