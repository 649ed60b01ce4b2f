"""Design of message layouts: widths, factors and row order that meet a target.

It may import the product and ``study``.
"""
