"""Attributes of records: all values of a record except mean and covariance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...values.arrays import floats
from ...values.errors import EncodeError
from ...values.line import Kind, Slot, Status


@dataclass(frozen=True, slots=True, eq=False)
class RecordAttributes:
    """Attributes of N records, each of shape (N,) or one value for all.

    Args:
        slot: line slot.
        counter: E2E counter, of which the record holds the low bits; None: 0, 1, ...
        kind: kind of the line.
        x_min: start of the valid range of the cubic [m], such as ``Refit.x_range`` has it.
        x_max: end of the valid range of the cubic [m]; by default, nothing is claimed ahead of
            the car.
        age: time from the pose to the sending [s]; infinite if too old or unknown.
        status: requested status; None: FULL. DIAGONAL requests the variances only.
        component_index: index of the component in its mixture, from 0.
        component_count: number of components of the mixture.
        component_weight: weight of the component.

    Raises:
        ValueError: a value is complex, or an integer beyond the largest float.
        EncodeError: a slot is not finite or out of range.
    """

    slot: ArrayLike = Slot.EGO_LEFT
    counter: ArrayLike | None = None
    kind: ArrayLike = Kind.UNKNOWN
    x_min: ArrayLike = 0.0
    x_max: ArrayLike = 0.0
    age: ArrayLike = 0.0
    status: ArrayLike | None = None
    component_index: ArrayLike = 0
    component_count: ArrayLike = 1
    component_weight: ArrayLike = 1.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None or field.default is not None:
                object.__setattr__(self, field.name, numbers(field.name, value))

    @classmethod
    def from_keywords(
        cls, keywords: Mapping[str, ArrayLike | None], allowed: Iterable[str] | None = None
    ) -> RecordAttributes:
        """Return the attributes given as keyword arguments.

        Raises:
            TypeError: a name is not one of the ``allowed``, by default all.
        """
        allowed = [field.name for field in fields(cls)] if allowed is None else list(allowed)
        if unknown := sorted(keywords.keys() - set(allowed)):
            raise TypeError(
                f"unknown attribute {', '.join(unknown)}; it must be one of {', '.join(allowed)}"
            )
        return cls(**keywords)  # type: ignore[arg-type]

    def without_covariance(self) -> RecordAttributes:
        """Return the attributes of records for which no covariance is given.

        Raises:
            ValueError: the requested status asserts a covariance.
        """
        if self.status is None:
            return replace(self, status=Status.UNKNOWN)
        if not np.isin(self.status, [Status.UNKNOWN, Status.OUT_OF_RANGE]).all():
            raise ValueError("covs must be given where status claims a covariance")
        return self

    def of_components(self, weights: NDArray[np.float64]) -> RecordAttributes:
        """Return the (N k,) attributes of the components of N lines, given their (N, k) weights.

        Component i gets counter + i. Without counters, the lines get 0, k, 2 k, ...
        """
        n, k = weights.shape
        first = np.arange(n) * k if self.counter is None else np.broadcast_to(self.counter, n)
        shared: dict[str, Any] = {
            name: np.repeat(np.broadcast_to(value, n), k)
            for name in LINE_ATTRIBUTES
            if name != "counter" and (value := getattr(self, name)) is not None
        }
        return RecordAttributes(
            **shared,
            counter=(first[:, None] + np.arange(k)).ravel(),
            component_index=np.tile(np.arange(k), n),
            component_count=k,
            component_weight=weights.ravel(),
        )


def numbers(name: str, values: ArrayLike) -> NDArray[Any]:
    """Return the values of an attribute as an array; raises as ``RecordAttributes``."""
    given = np.asarray(values)  # integers stay integers
    if given.dtype.kind in "Oc":  # such as integers beyond 64 bits
        given = floats(values, name)
    if name == "slot" and given.dtype.kind == "f":
        bad = ~((given >= 0) & (given <= max(Slot)))
        if bad.any():
            raise EncodeError(f"slot must be from 0 to {max(Slot)}, got {given[bad].flat[0]:g}")
    return given


#: Attributes that the components of a mixture share; those of the line.
LINE_ATTRIBUTES = tuple(
    field.name for field in fields(RecordAttributes) if not field.name.startswith("component_")
)
