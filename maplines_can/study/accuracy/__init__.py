"""Recorded drives on a map: the truth, and how accurate the received lines are.

It may import the product and ``study``.
"""
