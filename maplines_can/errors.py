"""The errors that a caller's mistake raises; what the bus sends never raises."""

__all__ = [
    "BusError",
    "EncodeError",
    "IllPosedError",
    "KeyMaterialError",
    "LayoutError",
    "LogError",
    "MaplinesError",
    "MissingExtraError",
    "StudyError",
]


class MaplinesError(Exception):
    """Base of all errors of this package: catch it to catch them all."""


class IllPosedError(MaplinesError, ValueError):
    """A line cannot be fitted: too few points, or points that double back."""


class LayoutError(MaplinesError, ValueError):
    """A DBC is missing, is unreadable, or does not describe a map line."""


class EncodeError(MaplinesError, ValueError):
    """A value has no place on the wire, and nothing may stand for it."""


class KeyMaterialError(MaplinesError, ValueError):
    """A secret key is missing or is none; the message never holds what was read."""


class MissingExtraError(MaplinesError, ImportError):
    """A package of an optional extra is not installed; the message names the extra."""


class BusError(MaplinesError, OSError):
    """A CAN interface cannot be opened, or cannot carry what is asked of it."""


class LogError(MaplinesError, OSError):
    """A log file cannot be read, or not all of it; what is good was read before."""


class StudyError(MaplinesError, ValueError):
    """A study cannot be made as asked: of this file, in this directory, with these workers."""
