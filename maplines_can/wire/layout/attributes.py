"""Attributes of records: all values of a record except mean and covariance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...values.arrays import floats, row_values
from ...values.errors import EncodeError
from ...values.line import Kind, Slot, Status
from .message_layout import Layout

#: Rows of the arrays of the core of values beside mean and covariance.
INTEGERS = ("counter", "kind", "status", "component_index", "component_count")
REALS = ("component_weight", "x_min", "x_max", "age")


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

    def rows(
        self, layout: Layout, n: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Return the attributes of n records: slots (n,), INTEGERS (5, n) and REALS (4, n).

        Raises:
            EncodeError: one cannot be encoded, such as a slot that the DBC does not have.
            ValueError: one has not n values, or one for all.
        """
        layout.data_ids(self.slot, n)
        integers = self._integers(layout, n)
        x_min, x_max = _finite("x_min", self.x_min, n), _finite("x_max", self.x_max, n)
        if (x_min > x_max).any():
            raise EncodeError("x_min must be x_max or less")
        age = row_values(np.asarray(self.age, dtype=float), n)
        if not (age >= 0).all():
            raise EncodeError(f"age must be 0 s or more, got {age[~(age >= 0)][0]:g}")
        weight = _finite("component_weight", self.component_weight, n)
        if ((weight <= 0) | (weight > 1)).any():
            raise EncodeError(f"component_weight must be in (0, 1], got {weight.min():g}")
        slot = np.full(n, self.slot, np.int64)
        return (
            slot,
            _stacked(integers, n, np.int64),
            _stacked([weight, x_min, x_max, age], n, float),
        )

    def _integers(self, layout: Layout, n: int) -> list[ArrayLike]:
        """Return each of INTEGERS, (n,) or one for all."""
        status = row_values(Status.FULL if self.status is None else self.status, n)
        counter = row_values(np.arange(n) if self.counter is None else self.counter, n)
        index, count = row_values(self.component_index, n), row_values(self.component_count, n)
        raw_status = layout["Status"].whole(status, max(Status))
        raw_counter = layout["Counter"].whole(counter % 2 ** layout["Counter"].length)
        raw_kind = layout["Kind"].whole(row_values(self.kind, n), max(Kind))
        layout["ComponentIndex"].whole(index)
        layout["ComponentCount"].whole(count)
        bad = index >= count
        if bad.any():
            i, k = (np.broadcast_to(values, bad.shape)[bad][0] for values in (index, count))
            raise EncodeError(f"component_index must be below component_count, got {i} of {k}")
        return [raw_counter, raw_kind, raw_status, index, count]


def _stacked(rows: list[ArrayLike], n: int, kind: type) -> NDArray[Any]:
    """Return (K, n) values of K rows, each of (n,) or one for all."""
    stacked: NDArray[Any] = np.empty((len(rows), n), kind)
    for row, values in zip(stacked, rows, strict=True):
        row[:] = values
    return stacked


def _finite(name: str, value: ArrayLike, n: int) -> NDArray[np.float64]:
    values = row_values(np.asarray(value, dtype=float), n)
    if not np.isfinite(values).all():
        raise EncodeError(f"{name} must be finite, got {values[~np.isfinite(values)][0]}")
    return values


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
