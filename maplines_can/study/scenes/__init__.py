"""Scenes of lines: a source of random ones, what codes make of them, and the fewest bits.

It may import the product and ``study``.
"""
