"""DBC files of any kind: their encoding, what cantools makes of them, and tables that are kept.

It may import ``values``.
"""
