"""Analyses structure: the faults that equations alone can distinguish, independent of their numbers.

Equations and unknowns form a bipartite graph; the overdetermined part of its decomposition (Dulmage and Mendelsohn
1958) is what redundancy can test. A fault is detectable when its equation lies there, and isolable from another when it
still does without the other's equation (Krysander and Frisk 2008; Frisk, Krysander and Jung 2017).
"""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import maximum_bipartite_matching

from tools.mismatch.recording import Recording


@dataclass(frozen=True)
class Structure:
    """Holds a structure: ``equations`` maps each equation to its unknowns, ``faults`` each fault to its equation."""

    equations: Mapping[str, frozenset[str]]
    faults: Mapping[str, str]


def overdetermined(structure: Structure) -> set[str]:
    """Return the overdetermined part: the equations that an alternating path joins to an unmatched equation."""
    names = list(structure.equations)
    unknowns = sorted({u for us in structure.equations.values() for u in us})
    if not unknowns:
        return set(names)
    column = {u: j for j, u in enumerate(unknowns)}
    graph = np.zeros((len(names), len(unknowns)), np.bool_)
    for i, e in enumerate(names):
        graph[i, [column[u] for u in structure.equations[e]]] = True
    match = maximum_bipartite_matching(csr_matrix(graph), perm_type="column")
    by = {int(j): i for i, j in enumerate(match) if j >= 0}
    ahead = [i for i, j in enumerate(match) if j < 0]
    found = set(ahead)
    while ahead:
        i = ahead.pop()
        for j in np.flatnonzero(graph[i]).tolist():
            k = by.get(j)
            if k is not None and k not in found:
                found.add(k)
                ahead.append(k)
    return {names[i] for i in found}


def isolability(structure: Structure) -> NDArray[np.bool_]:
    """Return a matrix (faults, faults) that is True where the row's fault cannot be isolated from the column's.

    A fault that cannot be detected has a row of True.
    """
    faults = list(structure.faults)
    out = np.ones((len(faults), len(faults)), np.bool_)
    testable = overdetermined(structure)
    for j, other in enumerate(faults):
        rest = {e: us for e, us in structure.equations.items() if e != structure.faults[other]}
        inside = overdetermined(replace(structure, equations=rest))
        for i, fault in enumerate(faults):
            equation = structure.faults[fault]
            out[i, j] = equation not in testable or equation not in inside
    return out


def groups(structure: Structure) -> list[tuple[str, ...]]:
    """Return the groups of faults that structure cannot distinguish, each group once."""
    faults, same = list(structure.faults), isolability(structure)
    seen: set[str] = set()
    out: list[tuple[str, ...]] = []
    for i, fault in enumerate(faults):
        if fault in seen:
            continue
        group = tuple(f for j, f in enumerate(faults) if same[i, j] and same[j, i])
        seen.update(group)
        out.append(group or (fault,))
    return out


def structure_of(recording: Recording) -> Structure:
    """Return the structure of a recording's twin with a fault at each input, at each state and at each output.

    Twins without readable equations are one equation from all inputs to each output.
    """
    text = recording.twin.parameters
    equations: dict[str, frozenset[str]] = {}
    faults: dict[str, str] = {}
    inputs = {s: f"true {s}" for s in recording.inputs}
    for s, true in inputs.items():
        equations[f"input {s}"] = frozenset((true,))
        faults[f"input {s}"] = f"input {s}"
    if recording.twin.kind == "ode" and isinstance(text.get("equations"), Mapping):
        _add_ode(equations, faults, inputs, text, list(recording.outputs))
    elif recording.twin.kind == "state_space" and "A" in text:
        _add_matrices(equations, faults, inputs, text, list(recording.outputs))
    else:
        for o in recording.outputs:
            equations[f"output {o}"] = frozenset(inputs.values())
            faults[f"output {o}"] = f"output {o}"
    return Structure(equations, faults)


def _table(value: object) -> dict[str, str]:
    return {str(k): str(v) for k, v in value.items()} if isinstance(value, Mapping) else {}


def _add_ode(
    equations: dict[str, frozenset[str]], faults: dict[str, str], inputs: Mapping[str, str], text: Mapping[str, object],
    outputs: Sequence[str],
) -> None:  # fmt: skip
    written, read = _table(text.get("equations")), _table(text.get("outputs"))
    states = list(_table(text.get("states")))
    known = {*states, *written, *inputs}

    def unknowns(expression: str) -> frozenset[str]:
        names = {n.id for n in ast.walk(ast.parse(expression, mode="eval")) if isinstance(n, ast.Name)}
        return frozenset(inputs.get(n, n) for n in names & known)

    for name, expression in written.items():
        if name in states:
            equations[f"state {name}"] = unknowns(expression) | {f"d {name}"}
            equations[f"derivative {name}"] = frozenset((name, f"d {name}"))
            faults[f"state {name}"] = f"state {name}"
        else:
            equations[f"between {name}"] = unknowns(expression) | {name}
    for o in outputs:
        equations[f"output {o}"] = unknowns(read.get(o, o))
        faults[f"output {o}"] = f"output {o}"


def _add_matrices(
    equations: dict[str, frozenset[str]], faults: dict[str, str], inputs: Mapping[str, str], text: Mapping[str, object],
    outputs: Sequence[str],
) -> None:  # fmt: skip
    a, b, c = (np.atleast_2d(np.asarray(text[k], np.float64)) for k in ("A", "B", "C"))
    b = b.T if b.shape[0] != a.shape[0] else b
    true = list(inputs.values())
    given = text.get("states")
    names = [str(s) for s in given] if isinstance(given, Mapping) else [f"x{i + 1}" for i in range(a.shape[0])]
    for i, name in enumerate(names):
        used = {names[j] for j in np.flatnonzero(a[i])} | {true[j] for j in np.flatnonzero(b[i]) if j < len(true)}
        equations[f"state {name}"] = frozenset({*used, f"d {name}"})
        equations[f"derivative {name}"] = frozenset((name, f"d {name}"))
        faults[f"state {name}"] = f"state {name}"
    for k, o in enumerate(outputs):
        equations[f"output {o}"] = frozenset(names[j] for j in np.flatnonzero(c[k]))
        faults[f"output {o}"] = f"output {o}"


def splitting_sensors(structure: Structure) -> dict[tuple[str, ...], tuple[str, ...]]:
    """Return for each group of faults that structure cannot split the unknowns whose measurement would split it."""
    unknowns = sorted({u for us in structure.equations.values() for u in us if not u.startswith("d ")})
    out: dict[tuple[str, ...], tuple[str, ...]] = {}
    for group in groups(structure):
        if len(group) < 2:
            continue
        helps: list[str] = []
        for u in unknowns:
            more = replace(structure, equations={**structure.equations, f"sensor {u}": frozenset((u,))})
            if not any(set(group) <= set(g) for g in groups(more)):
                helps.append(u)
        out[group] = tuple(helps)
    return out
