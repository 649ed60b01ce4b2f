"""The CAN bus: send lines and receive lines. With the logs, the only door to python-can.

python-can is loaded where a bus is opened or a log is written; with the extra mf4 it loads asammdf
and pandas, too, which reading other logs does not need.

It may import ``values``, ``wire`` and ``logs``.
"""

from .. import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__)
