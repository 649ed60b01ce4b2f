"""Descriptions of the signals, and the DBC that is written from them.

It may import the product and ``study``.
"""
