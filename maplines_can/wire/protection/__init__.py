"""Protection of records: AUTOSAR E2E profile 5 and SecOC.

It may import ``core``, ``values`` and ``wire.layout``.
"""
