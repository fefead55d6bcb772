"""Parses units as people write them (symbol -> dimension, factor, offset) and converts between equal dimensions."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from types import MappingProxyType

from hal.arrays import Array
from hal.types import STANDARD_GRAVITY

Dimension = tuple[int, ...]
"""Exponents of metre, kilogram, second, ampere, kelvin, radian, count, mole."""

_NONE: Dimension = (0, 0, 0, 0, 0, 0, 0, 0)


class UnitError(ValueError):
    """Reports an unknown unit, or a unit of another dimension."""


@dataclass(frozen=True)
class Unit:
    """Defines a unit by ``si = value * factor + offset``."""

    text: str
    dimension: Dimension
    factor: float
    offset: float = 0.0


def _d(
    *, m: int = 0, kg: int = 0, s: int = 0, a: int = 0, k: int = 0, rad: int = 0, count: int = 0, mol: int = 0
) -> Dimension:
    return (m, kg, s, a, k, rad, count, mol)


# symbol: (dimension, factor to SI, offset, takes SI prefixes)
_SYMBOLS = MappingProxyType(
    {
        "1": (_NONE, 1.0, 0.0, False),
        "%": (_NONE, 1e-2, 0.0, False),
        "ppm": (_NONE, 1e-6, 0.0, False),
        "m": (_d(m=1), 1.0, 0.0, True),
        "micron": (_d(m=1), 1e-6, 0.0, False),
        "in": (_d(m=1), 0.0254, 0.0, False),
        "ft": (_d(m=1), 0.3048, 0.0, False),
        "l": (_d(m=3), 1e-3, 0.0, True),
        "L": (_d(m=3), 1e-3, 0.0, True),
        "s": (_d(s=1), 1.0, 0.0, True),
        "sec": (_d(s=1), 1.0, 0.0, False),
        "min": (_d(s=1), 60.0, 0.0, False),
        "h": (_d(s=1), 3600.0, 0.0, False),
        "Hz": (_d(s=-1), 1.0, 0.0, True),
        "kg": (_d(kg=1), 1.0, 0.0, False),
        "gram": (_d(kg=1), 1e-3, 0.0, False),
        "mol": (_d(mol=1), 1.0, 0.0, True),
        "g": (_d(m=1, s=-2), STANDARD_GRAVITY, 0.0, True),
        "g0": (_d(m=1, s=-2), STANDARD_GRAVITY, 0.0, False),
        "gal": (_d(m=1, s=-2), 1e-2, 0.0, False),
        "N": (_d(m=1, kg=1, s=-2), 1.0, 0.0, True),
        "lbf": (_d(m=1, kg=1, s=-2), 4.4482216152605, 0.0, True),
        "kip": (_d(m=1, kg=1, s=-2), 4448.2216152605, 0.0, False),
        "kgf": (_d(m=1, kg=1, s=-2), STANDARD_GRAVITY, 0.0, False),
        "Nm": (_d(m=2, kg=1, s=-2), 1.0, 0.0, True),
        "J": (_d(m=2, kg=1, s=-2), 1.0, 0.0, True),
        "W": (_d(m=2, kg=1, s=-3), 1.0, 0.0, True),
        "Wh": (_d(m=2, kg=1, s=-2), 3600.0, 0.0, True),
        "Pa": (_d(m=-1, kg=1, s=-2), 1.0, 0.0, True),
        "hPa": (_d(m=-1, kg=1, s=-2), 1e2, 0.0, False),
        "bar": (_d(m=-1, kg=1, s=-2), 1e5, 0.0, True),
        "barg": (_d(m=-1, kg=1, s=-2), 1e5, 0.0, True),  # a difference to the pressure around
        "psi": (_d(m=-1, kg=1, s=-2), 6894.757293168361, 0.0, False),
        "A": (_d(a=1), 1.0, 0.0, True),
        "C": (_d(s=1, a=1), 1.0, 0.0, True),
        "Ah": (_d(s=1, a=1), 3600.0, 0.0, True),
        "V": (_d(m=2, kg=1, s=-3, a=-1), 1.0, 0.0, True),
        "ohm": (_d(m=2, kg=1, s=-3, a=-2), 1.0, 0.0, True),
        "F": (_d(m=-2, kg=-1, s=4, a=2), 1.0, 0.0, True),
        "H": (_d(m=2, kg=1, s=-2, a=-2), 1.0, 0.0, True),
        "T": (_d(kg=1, s=-2, a=-1), 1.0, 0.0, True),
        "G": (_d(kg=1, s=-2, a=-1), 1e-4, 0.0, True),
        "Gs": (_d(kg=1, s=-2, a=-1), 1e-4, 0.0, True),
        "gauss": (_d(kg=1, s=-2, a=-1), 1e-4, 0.0, True),
        "K": (_d(k=1), 1.0, 0.0, True),
        "degC": (_d(k=1), 1.0, 273.15, False),
        "°C": (_d(k=1), 1.0, 273.15, False),
        "degF": (_d(k=1), 5.0 / 9.0, 273.15 - 32.0 * 5.0 / 9.0, False),
        "°F": (_d(k=1), 5.0 / 9.0, 273.15 - 32.0 * 5.0 / 9.0, False),
        "rad": (_d(rad=1), 1.0, 0.0, True),
        "deg": (_d(rad=1), math.pi / 180, 0.0, True),
        "°": (_d(rad=1), math.pi / 180, 0.0, False),
        "dps": (_d(s=-1, rad=1), math.pi / 180, 0.0, True),
        "arcmin": (_d(rad=1), math.pi / 10800, 0.0, False),
        "arcsec": (_d(rad=1), math.pi / 648000, 0.0, False),
        "rev": (_d(rad=1), 2 * math.pi, 0.0, False),
        "turn": (_d(rad=1), 2 * math.pi, 0.0, False),
        "kn": (_d(m=1, s=-1), 1852.0 / 3600.0, 0.0, False),
        "mph": (_d(m=1, s=-1), 0.44704, 0.0, False),
        "rpm": (_d(s=-1, rad=1), 2 * math.pi / 60, 0.0, False),
        "rps": (_d(s=-1, rad=1), 2 * math.pi, 0.0, False),
        "count": (_d(count=1), 1.0, 0.0, False),
        "counts": (_d(count=1), 1.0, 0.0, False),
        "tick": (_d(count=1), 1.0, 0.0, False),
        "ticks": (_d(count=1), 1.0, 0.0, False),
        "LSB": (_d(count=1), 1.0, 0.0, False),
        "lsb": (_d(count=1), 1.0, 0.0, False),
    }
)


def listed() -> str:
    """Return the symbols of all units as text; of those that are the same the first."""
    first = {unit: symbol for symbol, unit in list(_SYMBOLS.items())[::-1]}
    return ", ".join(symbol for symbol in _SYMBOLS if symbol in first.values())


_PREFIXES = MappingProxyType(
    {"f": 1e-15, "p": 1e-12, "n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1}
    | {"k": 1e3, "M": 1e6, "G": 1e9}
)
_TERM = re.compile(r"^(?P<symbol>1|[^\d^+\-\s]+?)(?:\^?(?P<power>[+-]?\d+))?$")
_SUPERSCRIPTS = str.maketrans("²³⁻¹", "23-1")


def parse(text: str) -> Unit:
    """Parse a unit such as ``um/V``, ``m/s^2``, ``deg/s``, ``N m``, ``mg`` (milli-gravity), ``G`` (gauss).

    ``g`` is standard gravity, but a gram where it is divided by a volume or an amount of substance (``g/l``,
    ``mg/m^3``, ``g/mol``), because nobody records gravity per volume. Raises UnitError that names the unknown symbol.
    """
    cleaned = text.strip().translate(_SUPERSCRIPTS)
    if cleaned in ("", "-"):
        return Unit(text, _NONE, 1.0)
    terms = _terms(cleaned, text)
    if len(terms) == 1 and terms[0][1] == 1 and "/" not in cleaned:
        return Unit(text, *_symbol(terms[0][0], text))
    parts = [(symbol, power, *_symbol(symbol, text)[:2]) for symbol, power in terms]
    beside = _product([(power, dim) for symbol, power, dim, _ in parts if not _is_gravity(symbol)])
    if beside[1] == beside[3] == 0 and (beside[0] <= -3 or beside[7] < 0):
        gram = _SYMBOLS["gram"]
        parts = [
            (s, power, gram[0], gram[1] * f / STANDARD_GRAVITY) if _is_gravity(s) else (s, power, dim, f)
            for s, power, dim, f in parts
        ]
    factor = math.prod(f**power for _, power, _, f in parts)
    return Unit(text, _product([(power, dim) for _, power, dim, _ in parts]), factor)


def _terms(cleaned: str, text: str) -> list[tuple[str, int]]:
    """Return the symbols of a unit with their powers. Raises UnitError with the whole ``text``."""
    found: list[tuple[str, int]] = []
    for side, group in enumerate(cleaned.split("/")):
        terms = [w for w in re.split(r"[\s*·]+", group.strip().strip("()")) if w]
        if not terms:
            raise UnitError(f"unit '{text}' has an empty part; write it like m/s^2 or N m")
        for term in terms:
            match = _TERM.match(term)
            if match is None:
                raise UnitError(f"unknown unit '{text}' (cannot read '{term}')")
            power = int(match["power"] or 1)
            found.append((match["symbol"], power if side == 0 else -power))
    return found


def _product(terms: Iterable[tuple[int, Dimension]]) -> Dimension:
    """Return the dimension of a product of (power, dimension)."""
    found = list(_NONE)
    for power, dim in terms:
        found = [a + power * b for a, b in zip(found, dim, strict=True)]
    return tuple(found)


def _is_gravity(symbol: str) -> bool:
    """Return True for ``g`` and its multiples, which may be grams; ``kg`` and ``g0`` are one thing always."""
    return symbol == "g" or (symbol not in _SYMBOLS and symbol[:1] in _PREFIXES and symbol[1:] == "g")


def _symbol(symbol: str, text: str) -> tuple[Dimension, float, float]:
    direct = _SYMBOLS.get(symbol)
    if direct is not None:
        return direct[0], direct[1], direct[2]
    prefix, rest = symbol[:1], symbol[1:]
    entry = _SYMBOLS.get(rest)
    # no field has a thousand tesla: CO(GT) is a ground truth
    if prefix in _PREFIXES and entry is not None and entry[3] and not (rest == "T" and _PREFIXES[prefix] > 1.0):
        return entry[0], entry[1] * _PREFIXES[prefix], 0.0
    where = f" (symbol '{symbol}')" if symbol != text else ""
    raise UnitError(f"unknown unit '{text}'{where}; known, with powers and SI prefixes: {listed()}")


def is_unit(text: str | None) -> bool:
    """Return True for a unit that ``parse`` knows; False for none and for an empty text."""
    if not text:
        return False
    try:
        parse(text)
    except UnitError:
        return False
    return True


def same_dimension(a: str, b: str) -> bool:
    """Return True if values in ``a`` can be converted to ``b``."""
    return parse(a).dimension == parse(b).dimension


_USUAL = ("u", "m", "k", "M")
"""Prefixes of units that a column may be in without a word about it."""


def sizes_beside(unit: str) -> list[tuple[str, float]]:
    """Return the units of the dimension of ``unit``, each with the value in it of one ``unit``.

    Without a unit: the factors that columns are off by most often, with their words.
    """
    if not is_unit(unit) or parse(unit).dimension == _NONE:
        words = {"a factor of 1000": 1e3, "a factor of 1e6": 1e6, "degrees or radians": 180 / math.pi}
        words |= {"g or m/s^2": STANDARD_GRAVITY}
        return [(w, f) for w, size in words.items() for f in (size, 1 / size)]
    own = parse(unit)
    out = [
        (f"{prefix}{symbol}", own.factor / (factor * _PREFIXES.get(prefix, 1.0)))
        for symbol, (dimension, factor, _, prefixed) in _SYMBOLS.items()
        if dimension == own.dimension
        for prefix in ("", *(_USUAL if prefixed else ()))
    ]
    return out + [(f"{f:g} {unit}", 1 / f) for f in (1e-3, 1e3, 1e-6, 1e6)]


def convert(values: Array, unit: str, to: str) -> Array:
    """Convert values in ``unit`` to values in ``to``. Raises UnitError if the dimensions differ."""
    a, b = parse(unit), parse(to)
    if a.dimension != b.dimension:
        raise UnitError(f"unit '{unit}' is not of the dimension of '{to}'")
    if a.text == b.text or (a.factor == b.factor and a.offset == b.offset):
        return values
    return (values * a.factor + (a.offset - b.offset)) / b.factor


def convert_difference(value: float, unit: str, to: str) -> float:
    """Convert a difference (noise, resolution) in ``unit`` to one in ``to``, without offsets."""
    a, b = parse(unit), parse(to)
    if a.dimension != b.dimension:
        raise UnitError(f"unit '{unit}' is not of the dimension of '{to}'")
    return value * a.factor / b.factor
