"""TeX as plain text and as mathtext."""

import re

import pytest
from matplotlib.mathtext import MathTextParser

from sim_devices.physics.catalogue import EFFECTS
from tools.mismatch.report.equations import mathtext, plain
from tools.mismatch.report.page import BASE_EQUATIONS

ALL = {f"{e.name}-{i}": v.equation for e in EFFECTS.values() for i, v in enumerate((e, *e.variants))}


@pytest.mark.parametrize("key", list(ALL))
def test_every_equation_becomes_plain_text_and_type(key: str):
    text = plain(ALL[key])
    assert not re.search(r"\\|[{}]", text), text
    assert "=" in text
    MathTextParser("path").parse(mathtext(ALL[key]))


@pytest.mark.parametrize("tex", list(BASE_EQUATIONS.values()))
def test_base_equations_are_type(tex: str):
    MathTextParser("path").parse(mathtext(tex))


@pytest.mark.parametrize(
    ("tex", "text"),
    [
        (r"y = x + \sum_j c_j z_j,\quad \tau_j \dot z_j = x - z_j", "y = x + Σⱼ cⱼ zⱼ,   τⱼ z\u0307ⱼ = x - zⱼ"),
        (r"\ddot x + k x^3 = F_c\,\mathrm{sgn}\,\dot x", "x\u0308 + k x³ = F_c sgn x\u0307"),
        (r"a\,\Delta T \text{ behind a lag}", "a ΔT  behind a lag"),
        (r"y = a\,e^{-t/\tau} \sin 2\pi f t", "y = a e^(-t/τ) sin 2π f t"),
        (r"\sum_{j \ne i} m_{ij} f_j", "Σ_(j≠i) mᵢⱼ fⱼ"),
        (r"\sigma_i\,x,\; r_i \ll 1", "σᵢ x,  rᵢ ≪ 1"),
        (r"\Delta\,\mathrm{round}(x/\Delta)", "Δ round(x/Δ)"),
        (r"\dot h = \dots - a \sqrt{h_i - e}", "h\u0307 = … - a √(hᵢ - e)"),
        (r"J\ddot\varphi = M", "Jφ\u0308 = M"),
        (r"p_0 (1 \pm a (s - \bar s))", "p₀ (1 ± a (s - s\u0304))"),
        (r"\sqrt{g} \sum_{d \ge 2} c \quad\text{or}\quad 1", "√g Σ_(d≥2) c   or   1"),
    ],
)
def test_plain(tex: str, text: str):
    assert plain(tex) == text


def test_mathtext_knows_the_short_relations():
    assert mathtext(r"a \ge b \left( c \right)") == r"$a \geq b \left( c \right)$"
