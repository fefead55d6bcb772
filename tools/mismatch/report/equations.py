"""TeX of the effects as one line of plain text (terminals) and as mathtext (pages)."""

from __future__ import annotations

import re

_WORDS = {
    "tau": "τ", "omega": "ω", "alpha": "α", "lambda": "λ", "epsilon": "ε", "varphi": "φ", "theta": "θ", "pi": "π",
    "delta": "δ", "Delta": "Δ", "ell": "ℓ", "sum": "Σ", "times": "×", "cdot": "·", "ge": "≥", "le": "≤", "ne": "≠",
    "ll": "≪", "sigma": "σ", "sim": "~", "ln": "ln", "sin": "sin", "cos": "cos", "sgn": "sgn", "left": "", "right": "",
    "pm": "±",
}  # fmt: skip
_ACCENTS = {"dot": "\u0307", "ddot": "\u0308", "tilde": "\u0303", "bar": "\u0304"}
_SUPERSCRIPT = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
_SUBSCRIPT = str.maketrans("0123456789ijkhd", "₀₁₂₃₄₅₆₇₈₉ᵢⱼₖₕ\0")


def plain(tex: str) -> str:
    """Return TeX as one line of Unicode text, e.g. ``y = x + Σⱼ cⱼ zⱼ``."""
    # a TeX command consumes the space behind it
    text = re.sub(r"\\([dD])elta\s+(?=[A-Za-z])", r"\\\1elta{}", tex)
    text = re.sub(r"\\quad", "   ", text)
    text = re.sub(r"\\(?:mathrm|text)\{([^{}]*)\}", r"\1", text)
    text = re.sub(r"\\[,;! ]", " ", text)
    text = re.sub(r"\\dots(?![A-Za-z])", "…", text)  # before the accents, which would read it as a dotted s
    text = re.sub(r"\\sqrt\s*\{([^{}]*)\}", r"√(\1)", re.sub(r"\\sqrt\s*\{(\w)\}", r"√\1", text))
    for accent, mark in _ACCENTS.items():
        text = re.sub(rf"\\{accent}\s*(\\[A-Za-z]+|[A-Za-z])", lambda m, k=mark: _name(m[1]) + k, text)
    text = re.sub(r"\\([A-Za-z]+)", lambda m: _WORDS.get(m[1], m[1]), text)
    text = re.sub(r"_\{([^{}]*)\}", lambda m: _low(m[1]), text)
    text = re.sub(r"_(.)", lambda m: _low(m[1]), text)
    text = re.sub(r"\^(\d)", lambda m: m[1].translate(_SUPERSCRIPT), text)
    text = re.sub(r"\^\{([^{}]*)\}", r"^(\1)", text)
    return re.sub(r" {3,}", "   ", text.replace("{", "").replace("}", "")).strip()


def _name(symbol: str) -> str:
    return _WORDS.get(symbol[1:], symbol[1:]) if symbol.startswith("\\") else symbol


def _low(text: str) -> str:
    short = text.translate(_SUBSCRIPT)
    if short.isprintable() and all(ord(c) > 127 for c in short):
        return short
    return f"_{text}" if len(text) == 1 else f"_({text.replace(' ', '')})"


def mathtext(tex: str) -> str:
    """Return what matplotlib's mathtext reads: it knows ``\\geq`` but not ``\\ge``."""
    for short, long in (("ge", "geq"), ("le", "leq"), ("ne", "neq")):
        tex = re.sub(rf"\\{short}(?![A-Za-z])", rf"\\{long}", tex)
    return f"${tex}$"
