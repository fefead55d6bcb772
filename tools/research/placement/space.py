"""The space that an instrument leaves for accelerometers: boxes, and packages that must each lie in one of them."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError, model_validator

from hal.validation import StrictTable, describe_validation_error
from tools.errors import InputError

Vector = tuple[float, float, float]


class Box(StrictTable):
    """A box in the body frame, mm; a side of length zero makes it a plate, a line or a point."""

    name: str
    low_mm: Vector
    high_mm: Vector

    @model_validator(mode="after")
    def _ordered(self) -> Box:
        if any(a > b for a, b in zip(self.low_mm, self.high_mm, strict=True)):
            raise ValueError("low_mm is above high_mm")
        return self


class Space(StrictTable):
    """``SPACE.toml``. ``packages`` of ``axes_per_package`` axes each; a dual-axis package's axes are orthogonal."""

    format: Literal[1]
    title: str = "accelerometers"
    box: tuple[Box, ...] = Field(min_length=1)
    packages: Annotated[int, Field(ge=1, le=12)] = 3
    axes_per_package: Annotated[int, Field(ge=1, le=3)] = 2
    noise_m_s2: Annotated[float, Field(gt=0.0)] = 0.010
    tip_mm: Vector = (0.0, 0.0, 155.0)
    least: Literal["angular", "tip"] = "angular"
    largest_force_noise_m_s2: Annotated[float, Field(gt=0.0)] = 0.05
    """rms of the specific force at the tip: keeps all six degrees of freedom observable."""
    least_translation: Annotated[float, Field(ge=0.0, le=2.0)] = 1.0
    """Least eigenvalue of the sum of s s^T over the axes: 1 is one whole axis along the worst seen direction."""

    @model_validator(mode="after")
    def _enough(self) -> Space:
        if self.packages * self.axes_per_package < 6:
            raise ValueError(f"{self.packages * self.axes_per_package} axes: six degrees of freedom need six")
        return self


def load_space(path: Path) -> Space:
    """Read and check; ``InputError`` names the key."""
    try:
        return Space.model_validate(tomllib.loads(path.read_text()))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; benches/space-latt.toml is an example") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: {error}") from error
    except ValidationError as error:
        raise InputError(describe_validation_error(error, str(path))) from error


def space_latt(packages: int = 3, axes_per_package: int = 2) -> Space:
    """The space of Latt 2011 Fig. 8: a 26 mm square at the back end, the tool axis up to 130 mm (erratum 131)."""
    return Space(
        format=1,
        title="Latt 2011, Fig. 8",
        box=(
            Box(name="back", low_mm=(-13.0, -13.0, 0.0), high_mm=(13.0, 13.0, 0.0)),
            Box(name="handle", low_mm=(0.0, 0.0, 0.0), high_mm=(0.0, 0.0, 130.0)),
        ),
        packages=packages,
        axes_per_package=axes_per_package,
    )
