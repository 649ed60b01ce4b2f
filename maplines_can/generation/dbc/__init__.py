"""The DBCs of the package: each signal with its reason, and the writer.

It may import ``values`` and ``wire``.
"""
