"""Guesses roles, signals and units of columns, and the kind of twin, from names, courses of values and units."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from tools.mismatch import units
from tools.mismatch.column_course import Course, roles_of_courses
from tools.mismatch.twins.vocabulary import CONTEXT_UNITS, KINDS, Role, vocabulary

GuessedRole = Literal["time", "input", "output", "context", ""]
Parts = Mapping[str, tuple[str, str]]
"""The name without its unit, and the unit, of each column."""
Fits = Callable[[str, str, str, tuple[str, ...]], bool]
_SUFFIX = re.compile(
    r"^(?P<name>.*?)(?:\s*[\[(](?P<inside>[^\[\]()]+)[\])]|[_ /](?P<after>[^_ /\[\]()]+(?:/[^_ ]+)?))$"
)
_QUOTIENT = re.compile(r"^(?P<name>.+?)_(?P<over>1|[^\W\d_]+\d?)_(?P<under>s2?|m2|h|min|[lL])$")
"""A unit that is a quotient, in a language whose names hold no stroke: ``speed_rad_s``, ``sun_W_m2``, ``feed_g_l``."""
_AMOUNT = r"km|m3|m?[lL]|[mk]?g|m?mol"
_OVER = {"h": rf"1|{_AMOUNT}|[mk]?[AW]", "min": _AMOUNT, "l": r"[mku]?g|[mu]?mol", "L": r"[mku]?g|[mu]?mol"}
"""What may stand over a last part that is also a word or a side: ``x_V_min`` is a smallest voltage, ``force_N_l`` the
left one."""
_SPOKEN = {"mps": "m/s", "mps2": "m/s^2", "radps": "rad/s", "radps2": "rad/s^2", "pct": "%", "percent": "%"}
"""Units as names of columns spell them."""
_ORDINARY_WORDS = ("in", "ft", "min", "h", "l", "L", "F", "H")
"""Units that are also words or letters (``x_in``, ``x_min``, ``wheel_l``). They count as units in brackets only."""
_WORDS: tuple[tuple[GuessedRole, str], ...] = (
    ("context", r"temp|supply|\brail|ambient|humid|status|flag|state"),
    ("output", r"pos|disp|stroke|angle|vel|speed|meas|out|sensor|response|level|height|accel|path|weg"),
    ("input", r"command|cmd|input|drive|force|torque|current|set|demand|reference|excit|field|specific|kraft"),
)
_SURROUNDINGS = r"supply|ambient|room|humid|status|flag|state"
"""Names of context that stay context where no other column could answer."""
TEMPERATURE = "temperature"
_SIMULATED = re.compile(
    r"^(?:sim(?:ulated)?|model)[_\W]+|[_\W]+(?:sim(?:ulated)?|model)(?:[)\]]|(?=[_\W]|$))", re.IGNORECASE
)
"""The word that makes a column a simulated one, with what parts it from the rest of the name."""
_LETTERS: tuple[tuple[GuessedRole, str], ...] = (("input", r"u(\d|_|[A-Z]|$)"), ("output", r"y(\d|_|[A-Z]|$)"))
"""The letters of system identification: ``u``, ``u1``, ``uEst``, ``y_val``."""
_BY_UNIT: tuple[tuple[GuessedRole, str], ...] = (
    ("context", "degC"), ("input", "N"), ("input", "N m"), ("output", "m"), ("output", "m/s"), ("output", "rad"),
    ("output", "rad/s"), ("output", "m/s^2"), ("input", "V"), ("input", "A"),
)  # fmt: skip


@dataclass(frozen=True)
class Assignment:
    """Assigns roles and signals to columns. ``signals`` holds the columns with a role.

    ``named`` counts those that a name or a unit identified; ``notes`` lists unused columns, ``assumed`` guessed roles.
    """

    roles: dict[str, GuessedRole]
    signals: dict[str, str]
    named: int
    notes: tuple[str, ...] = ()
    assumed: tuple[str, ...] = ()


def split_unit(name: str) -> tuple[str, str]:
    """Return the name without its unit, and the unit; the unit is empty where the name ends in none."""
    quotient = _QUOTIENT.match(name.strip())
    if quotient is not None and (quotient["over"] != "in" or re.search(r"vel|speed", quotient["name"], re.IGNORECASE)):
        over, under = quotient["over"], quotient["under"]
        # ampere hours and watt hours are products
        unit = f"{over}h" if under == "h" and over[-1] in "AW" else f"{over}/{under}"
        if re.fullmatch(_OVER.get(under, r"[^\W\d_]+"), over) and units.is_unit(unit):
            return quotient["name"], unit
    found = _SUFFIX.match(name.strip())
    if found is None:
        return name.strip(), ""
    unit = (found["inside"] or found["after"]).strip()
    plain = found["name"].strip().rstrip(",").strip()
    unit = _SPOKEN.get(unit, unit)
    if unit in ("C", "F") and "temp" in plain.lower():
        unit = f"deg{unit}"
    if unit and not units.is_unit(unit):
        return name.strip(), ""
    if not found["inside"] and (unit.isdigit() or unit in _ORDINARY_WORDS):
        return name.strip(), ""
    return plain, unit


_TIME_UNITS = {"s": r"s|secs?|seconds?", "min": r"min|mins|minutes?", "h": r"h|hrs?|hours?", "ms": r"ms|msecs?"}
_TIME_SUFFIX = re.compile(
    r"^(?P<name>t|time|.*[ _-])??[ _-]?(?:" + "|".join(f"(?P<{u}>{p})" for u, p in _TIME_UNITS.items()) + r")$", re.I
)


def split_clock(name: str) -> tuple[str, str]:
    """Return the name of a column of time without its unit, and the unit: of time, ``h`` and ``min`` are no words.

    The unit is empty where the name ends in none.
    """
    plain, unit = split_unit(name)
    if unit or (found := _TIME_SUFFIX.match(name.strip())) is None:
        return plain, unit
    return (found["name"] or "time").rstrip(" _-"), next(u for u in _TIME_UNITS if found[u])


def role_of_name(name: str) -> GuessedRole:
    """Return the role that a name suggests; empty for no idea."""
    for role, pattern in _WORDS:
        if re.search(pattern, name, re.IGNORECASE):
            return role
    for role, pattern in _LETTERS:
        if re.match(pattern, name):
            return role
    return ""


def guess_role(name: str, unit: str) -> GuessedRole:
    """Return the role that a name, or else a unit, suggests; empty for no idea."""
    if role := role_of_name(name):
        return role
    for role, of in _BY_UNIT:
        if unit and units.same_dimension(unit, of):
            return role
    return ""


def roles_by_values(courses: Mapping[str, Course], parts: Parts) -> dict[str, GuessedRole]:
    """Return the roles that the courses of columns tell, where neither name nor unit says that a column is context."""
    named = {name: role_of_name(parts[name][0]) for name in courses}
    by_unit = {name: guess_role(*parts[name]) for name in courses}
    asked = [name for name in courses if "context" not in (named[name], by_unit[name])]
    return {**roles_of_courses({name: courses[name] for name in asked}, named, by_unit)}


def choose_kinds(names: Sequence[str], parts: Parts, by_values: Mapping[str, GuessedRole]) -> list[str]:
    """Return the kinds of twins whose vocabulary takes most columns by name or unit, both ways; several fit equally.

    A kind that would drive what ``by_values`` is a reading, or answer with a command, does not fit.
    """
    fits: dict[str, int] = {}
    for kind, words in KINDS.items():
        if words.open_ended or (found := assign(kind, names, parts, by_values, by_order=False)) is None:
            continue
        if all(found.roles[name] in (role, "context", "") for name, role in by_values.items()):
            fits[kind] = found.named
    return [kind for kind, named in fits.items() if named == max(fits.values())]


def assign(
    kind: str, names: Sequence[str], parts: Parts, by_values: Mapping[str, GuessedRole], *, by_order: bool = True
) -> Assignment | None:
    """Give every column a role and a signal of a twin of ``kind``; None if no input or no output remains.

    ``by_values``: the roles of ``roles_by_values``. With ``by_order``, columns without a telling name or unit take the
    free places by their values, else in their order.
    """
    words = vocabulary(kind) if kind else None
    if words is None or words.open_ended:
        return _assign_freely(kind, names, parts, by_values)
    found = _Places(kind, parts)
    hints: dict[str, GuessedRole] = {name: role_of_name(parts[name][0]) for name in names}
    for name in names:  # the twin's own words
        found.take_if(name, hints[name], lambda own, _, pattern, __: re.fullmatch(pattern, own) is not None)
    no_hints: dict[str, GuessedRole] = dict.fromkeys(names, "")
    for of in (hints, no_hints):  # a unit of the twin; u_x_V may be what an accelerometer answers
        for name in names:
            found.take_if(
                name,
                of[name] if hints[name] != "context" else "context",
                lambda _, unit, __, known: unit != "" and any(units.same_dimension(unit, u) for u in known),
            )
    named = len(found.roles)
    assumed: list[str] = []
    if by_order:
        for name in names:
            if name not in found.roles and not parts[name][1] and hints[name] != "context":
                before = len(found.roles)
                turn: GuessedRole = "output" if "input" in found.roles.values() else "input"
                found.take_if(name, hints[name] or by_values.get(name, turn), lambda *_: True)
                if len(found.roles) > before:
                    assumed.append(f"'{name}' is {_article(found.roles[name])}, {found.signals[name]}")
    dropped = found.drop_what_does_not_fit()
    if not {"input", "output"} <= set(found.roles.values()):
        return None
    notes = [f"column '{name}' is not used: {why}" for name, why in dropped.items()]
    for name in names:
        if name in found.roles or name in dropped:
            continue
        plain, unit = parts[name]
        rival = found.rival(unit) if unit and hints[name] != "context" else ""
        if rival:
            found.roles[name] = ""
            notes.append(f"column '{name}' is not used: '{rival}' is the {found.signals[rival]} already")
            continue
        found.roles[name] = "context"
        found.signals[name] = _context_signal(plain, unit, found.signals)
        if hints[name] != "context":
            notes.append(f"column '{name}' is context: a {kind} has no other place for it")
    for name in dropped:
        found.roles[name] = ""
    return Assignment(found.roles, found.signals, named, tuple(notes), tuple(assumed))


class _Places:
    """Maps the signals of a closed kind to the columns that occupy them."""

    def __init__(self, kind: str, parts: Parts) -> None:
        words = KINDS[kind]
        self.kind = kind
        self.of: dict[Role, tuple[tuple[str, tuple[str, ...]], ...]] = {"input": words.inputs, "output": words.outputs}
        self.parts = parts
        self.roles: dict[str, GuessedRole] = {}
        self.signals: dict[str, str] = {}

    def take_if(self, name: str, hint: GuessedRole, fits: Fits) -> None:
        """Give a column the first free signal for which ``fits(own, unit, pattern, units)`` holds."""
        if name in self.roles or hint == "context":
            return
        plain, unit = self.parts[name]
        own = word(plain)
        for role, patterns in self.of.items():
            if hint and hint != role:
                continue
            for pattern, known in patterns:
                if unit and not any(units.same_dimension(unit, u) for u in known):
                    continue
                signal = self._signal(own, pattern)
                if signal and signal not in self.signals.values() and fits(own, unit, pattern, known):
                    self.roles[name], self.signals[name] = role, signal
                    return

    def _signal(self, own: str, pattern: str) -> str:
        if re.fullmatch(pattern, own):
            return own
        if not pattern.endswith("[xyz]"):
            return pattern
        axis = own[-1].lower()
        if "\\" in pattern:  # any place, then the axis
            return f"{pattern.split(chr(92))[0]}{own}" if axis in "xyz" else ""
        if axis not in "xyz":
            return next((s for a in "xyz" if (s := pattern.replace("[xyz]", a)) not in self.signals.values()), "")
        return pattern.replace("[xyz]", axis)

    def drop_what_does_not_fit(self) -> dict[str, str]:
        """Take places back that the loader would refuse beside the others; return the columns, each with the reason."""
        dropped: dict[str, str] = {}
        inputs = [n for n, r in self.roles.items() if r == "input"]
        outputs = [n for n, r in self.roles.items() if r == "output"]
        if self.kind == "mechanical_axis" and inputs:
            for name in inputs[1:]:
                dropped[name] = f"'{inputs[0]}' drives the axis already"
            turns = self.signals[inputs[0]] == "torque"
            for name in outputs:
                unit = self.parts[name][1]
                if unit and (units.parse(unit).dimension[5] != 0) != turns:
                    dropped[name] = f"its unit {unit} does not go with a {self.signals[inputs[0]]}"
        prefix = {"accelerometer": "specific_force", "accelerometer_cluster": "specific_force", "magnetometer": "field"}
        if self.kind in prefix:
            driven = {self.signals[n] for n in inputs}
            for name in outputs:
                needed = f"{prefix[self.kind]}_{self.signals[name][-1]}"
                if needed not in driven:
                    dropped[name] = f"no column is its input {needed}"
        for name in dropped:
            del self.roles[name], self.signals[name]
        return dropped

    def rival(self, unit: str) -> str:
        """The column of the same dimension that has an input or output, or empty."""
        return next(
            (n for n, r in self.roles.items()
             if r in ("input", "output") and self.parts[n][1] and units.same_dimension(self.parts[n][1], unit)),
            "",
        )  # fmt: skip


def simulated_courses(names: Sequence[str], parts: Parts) -> dict[str, str]:
    """Return the columns of simulated output, by name (``sim_x_mm``), each with the column of that output (``x_mm``).

    The output is empty where no column of the same dimension has the rest of the name.
    """
    rests = {name: rest for name in names if (rest := _SIMULATED.sub("", name, count=1)) not in (name, "")}
    others = [name for name in names if name not in rests]
    by_word = {word(parts[name][0]).lower(): name for name in others} | {word(name).lower(): name for name in others}
    found: dict[str, str] = {}
    for name, rest in rests.items():
        wanted = (word(rest).lower(), word(split_unit(rest)[0]).lower())
        output = next((by_word[own] for own in wanted if own in by_word), "")
        unit = simulated_unit(name, parts)
        is_alike = not output or not unit or not parts[output][1] or units.same_dimension(unit, parts[output][1])
        found[name] = output if is_alike else ""
    return found


def simulated_unit(name: str, parts: Parts) -> str:
    """Return the unit of a simulated column, which may stand before the word for it (``x_mm_simulated``)."""
    return parts[name][1] or split_unit(_SIMULATED.sub("", name, count=1))[1]


def _assign_freely(
    kind: str, names: Sequence[str], parts: Parts, by_values: Mapping[str, GuessedRole]
) -> Assignment | None:
    """Assign roles for a twin that takes any signal: by name, values or unit, else the first column drives and the
    others answer."""
    roles: dict[str, GuessedRole] = {name: by_values.get(name) or guess_role(*parts[name]) for name in names}
    courses = simulated_courses(names, parts) if kind == "columns" else {}
    simulated = {name: output for name, output in courses.items() if output}
    roles |= {name: "input" if output else "context" for name, output in courses.items()}
    roles |= dict.fromkeys(simulated.values(), "output")
    used = [name for name in names if roles[name] != "context"]
    for asides in (_WORDS[0][1], _SURROUNDINGS):  # a heater: the last temperatures are no context, unless named so
        if len(used) < 2:
            inside = [k for k in names if roles[k] == "context" and not re.search(asides, parts[k][0], re.IGNORECASE)]
            answers = len(used) == 1 and roles[used[0]] != "output"
            roles |= dict.fromkeys(inside[len(used) - 2 :], "output" if answers else "")
            used = [name for name in names if roles[name] != "context"]
    if len(used) < 2:
        return None
    for role, name in (("input", used[0]), ("output", used[-1])):
        if role not in (roles[k] for k in used):
            free = next((k for k in (used if role == "input" else used[::-1]) if not roles[k]), name)
            roles[free] = "input" if role == "input" else "output"
    for name in used:
        roles[name] = roles[name] or ("input" if simulated else "output")
    alone = [name for name in used if simulated and roles[name] == "output" and name not in simulated.values()]
    roles |= dict.fromkeys(alone, "context")
    notes = tuple(f"column '{name}' is context: no column is its simulated course" for name in alone)
    sure = {name for name in names if role_of_name(parts[name][0]) == roles[name]} | {*courses}
    phrases = {"input": "inputs are", "output": "outputs are", "context": "context is"}
    by_role = {phrase: [k for k in names if roles[k] == role] for role, phrase in phrases.items()}
    assumed = [f"{phrase} {_quoted(of)}" for phrase, of in by_role.items() if not sure.issuperset(of)]
    signals: dict[str, str] = {}
    for name in names:
        plain, unit = parts[name]
        signals[name] = (
            _context_signal(plain, unit, signals) if roles[name] == "context" else _unused(word(plain), signals)
        )
    for name, output in simulated.items():
        signals[name] = f"simulated_{signals[output]}"
    return Assignment(roles, signals, sum(bool(guess_role(*parts[k])) for k in used), notes, tuple(assumed))


def word(plain: str) -> str:
    """Return a column's name as a signal: letters, digits and underscores."""
    return re.sub(r"\W+", "_", plain).strip("_") or "signal"


def _context_signal(plain: str, unit: str, used: Mapping[str, str]) -> str:
    """Return the signal of the contract that the name means, where the unit goes with it, else the name.

    What is in degrees is the temperature, whatever it is called, if no column is so yet.
    """
    for signal, known in CONTEXT_UNITS.items():
        fits = any(units.same_dimension(unit, u) for u in known) if unit else True
        if signal[:4] in plain.lower() and fits:
            return _unused(signal, used)
        if signal == TEMPERATURE and unit and fits and signal not in used.values():
            return signal
    own = word(plain)
    return _unused(f"{own}_beside" if own in CONTEXT_UNITS else own, used)


def _unused(own: str, signals: Mapping[str, str]) -> str:
    used = set(signals.values())
    return next(s for k in range(len(used) + 1) if (s := own if k == 0 else f"{own}_{k + 1}") not in used)


def _quoted(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)


def _article(role: str) -> str:
    return f"an {role}" if role else "not used"
