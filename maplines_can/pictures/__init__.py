"""Pictures of maps, of drives and of lines over a bus, by matplotlib; ``figure.py`` is its door.

It may import the product below ``restbus``.
"""
