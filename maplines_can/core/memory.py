"""Memory that Python owns and the core reads or writes: arrays and structures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from . import ffi

__all__ = ["dtype_of", "new", "pointer", "pointers", "shaped", "structure"]

#: Type that cffi takes for any pointer.
_ANY = ffi.typeof("void *")
#: Types of arrays, by those of the elements in NumPy.
_TYPES = {
    np.dtype(kind): ffi.typeof(f"{name}[]")
    for kind, name in {
        "f8": "double", "f4": "float", "i8": "int64_t", "u4": "uint32_t", "u2": "uint16_t",
        "u1": "uint8_t", "i1": "int8_t", "b1": "uint8_t",
    }.items()
}  # fmt: skip
#: Types of the members of structures; cffi says bool where C has _Bool.
_DTYPES = {
    "_Bool": "?", "uint8_t": "u1", "uint32_t": "u4", "int64_t": "i8", "double": "f8",
}  # fmt: skip
#: Allocate memory that is not cleared, by the name of its type and a length.
new: Callable[..., Any] = ffi.new_allocator(should_clear_after_alloc=False)


def pointer(array: NDArray[Any], *, written: bool = False) -> Any:
    """Return the pointer to the elements of an array, which it keeps alive.

    Raises:
        KeyError: elements are of a type that the core has not, also by their byte order.
        ValueError: the array is not in C order, or may not be written to.
    """
    return ffi.from_buffer(_TYPES[array.dtype], array, written)


def shaped(array: NDArray[Any], shape: tuple[int, ...]) -> Any:
    """Return the pointer to the elements of an array, in C order.

    Raises:
        ValueError: it has another shape, so that C would read beyond it.
    """
    if array.shape != shape:
        raise ValueError(f"an array must have shape {shape}, got {array.shape}")
    return pointer(np.ascontiguousarray(array))


def pointers(arrays: Sequence[NDArray[Any] | None]) -> Any:
    """Return pointers to arrays of double precision, as a C array; NULL for None."""
    kept = [ffi.NULL if array is None else pointer(array) for array in arrays]
    made = ffi.new("const double *[]", kept)
    _kept[made] = kept
    return made


def structure(name: str, content: Mapping[Any, Any]) -> Any:
    """Return a structure with the members of a mapping; None is left out: 0.

    Members are numbers, texts, arrays, tuples (the members of a structure in their order), mappings
    by name (a structure) or by index (an array). It keeps alive what it points to.
    """
    kept: list[Any] = []
    made = ffi.new(f"{name} *", _plain(content, kept))
    _kept[made] = kept
    return made


def dtype_of(name: str, **shapes: tuple[int, ...]) -> np.dtype[np.void]:
    """Return the dtype of a structure of numbers and arrays; ``shapes`` of some are as given."""
    members = []
    for member, field in ffi.typeof(name).fields:
        kind, shape = field.type, []
        while kind.kind == "array":
            shape.append(kind.length)
            kind = kind.item
        members.append((member, _DTYPES[kind.cname], shapes.get(member, tuple(shape))))
    return np.dtype(members, align=True)


_kept: WeakKeyDictionary[Any, list[Any]] = WeakKeyDictionary()


def _plain(value: Any, kept: list[Any]) -> Any:
    """Return content as cffi takes it; ``kept`` gets what it points to."""
    if isinstance(value, Mapping):
        given = {key: _plain(item, kept) for key, item in value.items() if item is not None}
        if all(isinstance(key, str) for key in given):
            return given
        return [given.get(index, {}) for index in range(max(given) + 1)]
    if isinstance(value, str):
        kept.append(ffi.new("char[]", value.encode(errors="replace")))
        return kept[-1]
    if isinstance(value, np.ndarray):
        kept.append(ffi.from_buffer(value))
        return ffi.cast(_ANY, kept[-1])
    return value
