"""Errors raised for a mistake of the caller; nothing received from the bus raises."""


class MaplinesError(Exception):
    """Base class of all errors of this package."""


class IllPosedError(MaplinesError, ValueError):
    """A cubic y(x) cannot be fitted: too few points, or points that are not a function of x."""


class LayoutError(MaplinesError, ValueError):
    """A DBC is missing, is unreadable, or does not describe a map line."""


class EncodeError(MaplinesError, ValueError):
    """A value or a slot cannot be represented with the DBC in use."""


class KeyMaterialError(MaplinesError, ValueError):
    """A secret key is missing or malformed. The message never contains what was read."""


class MissingExtraError(MaplinesError, ImportError):
    """A package of an optional extra is not installed. The message names the extra."""


class CoreError(MaplinesError, ImportError):
    """There is no library of the core, or it is not that of this version of the package."""


class BusError(MaplinesError, OSError):
    """A CAN interface cannot be opened, or does not support what is requested."""


class LogError(MaplinesError, OSError):
    """A log file cannot be read, or only in part; its good records were returned before."""


class MapFileError(MaplinesError, ValueError):
    """A map file cannot be read, or contains nothing that can be used."""


class DriveFileError(MaplinesError, ValueError):
    """A recorded drive cannot be used: a file, a column, a value, or positions off the map."""


class RouteError(MaplinesError, ValueError):
    """A map has no route between two lanes, or no such lane."""


class FmuError(MaplinesError, ValueError):
    """An FMU cannot be read, is no node of a CAN bus, or fails while it runs."""


class RestbusError(MaplinesError, ValueError):
    """A configuration, a script or a command of a restbus simulation is wrong."""


class EngineError(MaplinesError, ValueError):
    """The workers of a long piece of work cannot be reached, or die again and again."""


class StudyError(MaplinesError, ValueError):
    """A study cannot run with the given file, output directory or workers."""


def missing_extra(what: str, extra: str) -> MissingExtraError:
    """Return the error for a package that is not installed, with the command that installs it.

    Args:
        what: the feature and the package that it needs.
        extra: optional extra that includes the package.

    >>> print(missing_extra("authentication needs cryptography", "secoc"))
    authentication needs cryptography; install the extra "secoc": in a checkout of maplines_can,
    pip install -e ".[secoc]"
    """
    return MissingExtraError(
        f'{what}; install the extra "{extra}": in a checkout of maplines_can, '
        f'pip install -e ".[{extra}]"'
    )
