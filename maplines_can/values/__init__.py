"""Values that all parts share: Gaussians, lines of a map, scenes, errors.

It may import ``core``.
"""
