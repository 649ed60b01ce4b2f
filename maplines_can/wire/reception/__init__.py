"""From received frames to lines: reassembly, checks, the newest line of each slot.

It may import ``core``, ``values``, ``wire.layout`` and ``wire.protection``.
"""
