"""The figures of the paper, and the picture of a round trip.

It may import the product and ``study``.
"""
