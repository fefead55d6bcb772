"""A record is declared once: its class gives the layout, the lengths and the view, and refuses what has no layout."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_py.records import Records, attributes, field, new, record
from hal.arrays import Array, IntArray


@record
class Inner:
    """A record within another."""

    x: float = field("m")


@record
class Base:
    """What several records share."""

    count: int = field("1")
    values: Array = field("V", 2, "n")


@record
class Whole(Base):
    """All kinds of fields."""

    inner: Inner = field("")
    several: Records[Inner] = field("", 3)
    places: IntArray = field("1", "n")


def test_layout_is_as_declared_and_fields_of_the_base_come_first() -> None:
    assert new(Whole, {"n": 4}).dtype == np.dtype(
        [
            ("count", "i8"),
            ("values", "f8", (2, 4)),
            ("inner", [("x", "f8")]),
            ("several", [("x", "f8")], (3,)),
            ("places", "i8", (4,)),
        ]
    )


def test_lengths_are_those_of_the_values() -> None:
    made = new(Whole, values=np.ones((2, 5)), inner=new(Inner, x=2.0), count=7)
    assert made["places"].shape == (1, 5)
    view = attributes(made)[0]
    assert (view.count, view.inner.x, view.values.sum(), view.several["x"].sum()) == (7, 2.0, 10.0, 0.0)


def test_a_length_is_given_once() -> None:
    with pytest.raises(TypeError, match="the length 'n' is not given"):
        new(Whole)
    with pytest.raises(TypeError, match=r"Whole.places: 'n' is 4 here and 5 elsewhere"):
        new(Whole, values=np.ones((2, 5)), places=np.zeros(4, np.int64))
    with pytest.raises(KeyError):
        new(Inner, y=1.0)


def test_what_has_no_layout_or_no_unit_is_refused() -> None:
    class Text:
        name: str = field("1")

    class Bare:
        x: float = field("")

    class Scalar:
        x: float = field("m", 3)

    for kind in (Text, Bare, Scalar):
        with pytest.raises(TypeError, match="is no field of a record"):
            record(kind)
