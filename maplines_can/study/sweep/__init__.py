"""The study of covariance codes: sets of Gaussians through codes and widths, into tables.

It may import the product and ``study``.
"""
