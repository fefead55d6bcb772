"""What an effect is: one piece of physics that a simulator may lack, as a pure forward model.

The mismatch engine proposes these, fits their parameters inside the simulator, and puts the accepted ones
into a corrected twin. One effect per vocabulary name of the contract (recordings-and-mismatch.md, section 3);
one family of shapes per effect.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Stage = Literal["amplifier", "actuator", "mechanics", "mounting", "sensor", "acquisition", "environment"]
ActsOn = Literal["input", "output", "feedback", "timebase"]
"""Where the forward model sits in a twin.

input     replaces one input signal before the base physics
output    replaces one output signal after the base physics (additive terms are outputs too)
feedback  a force phi(position, velocity, t) inside the equation of motion
timebase  re-times all inputs or all outputs of a record
"""


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect. Bounds are in ``unit``; ``log`` says that its size, not its value, is uncertain.

    A ``unit`` may contain ``{in}`` and ``{out}``, the units of the signals that the effect sits on.
    """

    name: str
    unit: str
    lo: float
    hi: float
    log: bool = False


@dataclass(frozen=True)
class Context:
    """What a forward model may look at besides the signal that it changes.

    ``t`` seconds (n,), ``dt`` its step; ``signals`` every recorded input and context signal by the twin's name
    (n,), in the units of the contract; ``target`` the signal that the effect sits on. ``starts`` are sample
    indices where simulation starts afresh (0 first): memory is cleared there. ``t`` is time since the start of
    the whole recording, so that warm-up keeps its age in a held-out block.
    """

    t: Array
    dt: float
    signals: Mapping[str, Array]
    target: str
    starts: tuple[int, ...] = (0,)


@dataclass(frozen=True)
class Signature:
    """Outcome of the cheap test by which a residual shows that an effect may be there.

    ``p_value`` under the null that the residual does not know of the effect; ``share`` the part of the
    residual's variance that this effect could take at best, 0..1.
    """

    p_value: float
    share: float
    note: str = ""


Forward = Callable[[Array, Context, Array], Array]
Basis = Callable[[Array, Context, Array], Array]
Guess = Callable[[Array, Array, Context], Sequence[Array]]
SignatureTest = Callable[[Array, Array, Context], Signature]


@dataclass(frozen=True)
class Effect:
    """One effect of the vocabulary.

    ``forward(x, ctx, p) -> y``: ``x`` (n,) the signal that it changes, ``p`` in the order of ``parameters``,
    result (n,). Pure: same arguments, same answer; no state left behind.
    For ``acts_on == "feedback"``, ``x`` is unused and ``feedback_kernel`` names the compiled term.
    ``linear`` names the parameters in which the forward model is linear (additive terms): ``basis(x, ctx, p)``
    then gives one column (n, k) for each of them, with ``forward = x + basis @ p[linear]``; the engine solves
    these exactly instead of searching.
    ``guess(x, residual, ctx)`` gives starting points; ``signature(x, residual, ctx)`` is the screening test.
    ``equation`` is TeX; ``source`` paper and equation, or standard text.
    """

    name: str
    form: str
    stages: tuple[Stage, ...]
    acts_on: ActsOn
    parameters: tuple[Parameter, ...]
    forward: Forward
    guess: Guess
    signature: SignatureTest
    equation: str
    source: str
    linear: tuple[str, ...] = ()
    basis: Basis | None = None
    needs: tuple[str, ...] = ()
    feedback_kernel: str = ""
    excitation: str = ""
    """What a recording must contain to show this effect, in words."""
