"""The HTML report on the tables of a sweep.

It may import the product and ``study``.
"""
