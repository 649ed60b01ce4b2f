"""Global names of the sources of an FMU, which begin with a prefix as those of FMI do."""

from __future__ import annotations

import re
from collections.abc import Iterable

_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
_FUNCTION = re.compile(r"\b(maplines_\w+)(?=\()")
_CONSTANT = re.compile(r"\bextern const [\w ]+?\b(maplines_\w+)(?=[;\[])")
_MACRO = re.compile(r"^#define (maplines_\w+)", re.MULTILINE)


def names_header(identifier: str, headers: Iterable[str]) -> str:
    """Return ``names.h``, which each source includes first.

    Args:
        identifier: of the model.
        headers: all that declare functions and constants; those that they define as macros have a
            prefix by these, from ``MAPLINES_NAMESPACE``.
    """
    text = _COMMENT.sub("", "\n".join(headers))
    names = {*_FUNCTION.findall(text), *_CONSTANT.findall(text)} - {*_MACRO.findall(text)}
    defined = "".join(f"#define {name} MAPLINES_PREFIXED({name})\n" for name in sorted(names))
    return HEADER.format(identifier=identifier, names=defined)


HEADER = """\
/* Global names of this FMU: all begin with a prefix, so that several FMUs can be in one program.
 *
 * It is that of the functions of FMI, by the macros of fmi3Functions.h. A shared library is
 * compiled with FMI3_OVERRIDE_FUNCTION_PREFIX: functions of FMI have no prefix then, and the others
 * have the model identifier.
 */
#ifndef MAPLINES_NAMES_H
#define MAPLINES_NAMES_H

#ifndef FMI3_FUNCTION_PREFIX
#define FMI3_FUNCTION_PREFIX {identifier}_
#endif
#ifndef FMI3_OVERRIDE_FUNCTION_PREFIX
#define MAPLINES_NAMESPACE FMI3_FUNCTION_PREFIX
#elif defined(FMI3_ACTUAL_FUNCTION_PREFIX)
#define MAPLINES_NAMESPACE FMI3_ACTUAL_FUNCTION_PREFIX
#else
#define MAPLINES_NAMESPACE {identifier}_
#endif
#define MAPLINES_PREFIXED(name) MAPLINES_PREFIXED_BY(MAPLINES_NAMESPACE, name)
#define MAPLINES_PREFIXED_BY(prefix, name) MAPLINES_WITH_PREFIX(prefix, name)
#define MAPLINES_WITH_PREFIX(prefix, name) prefix##name

{names}
#endif
"""
