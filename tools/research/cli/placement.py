"""Implements ``micron placement``: it finds positions of accelerometers in a given space."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tools.cli.common import JsonOption, clear_errors, console, data_console
from tools.errors import InputError
from tools.output import check_names, check_writable, write_json
from tools.terminal import table_of


def placement(
    space_file: Annotated[
        Path, typer.Argument(metavar="SPACE.toml", help="Boxes, packages, noise; see benches/space-latt.toml.")
    ],
    image: Annotated[Path, typer.Option("--picture", metavar="FILE", help="Picture (PNG) of the instrument.")] = Path(
        "out/placement.png"
    ),
    seed: Annotated[int, typer.Option(help="Seed of the coarse search.")] = 0,
    json_file: JsonOption = None,
) -> None:
    """Find places of accelerometers with the least angular (or tip) noise, beside those of Latt 2011.

    Example: micron placement benches/space-latt.toml
    """
    from dataclasses import asdict

    import numpy as np

    from tools.research.placement.configurations import cube_004, micron_004, micron_004_turned, proposed_004
    from tools.research.placement.optimise import optimise
    from tools.research.placement.picture import save_placement_picture
    from tools.research.placement.propositions import check_pairs, verdicts
    from tools.research.placement.space import load_space
    from tools.research.placement.variance import angular_noise, point_noise

    with clear_errors():
        check_names(image)
        check_writable(json_file)
        space = load_space(space_file)
        try:
            best = optimise(space, seed)
        except ValueError as error:
            raise InputError(str(error)) from error
        tip = np.array(space.tip_mm) * 1e-3
        title = f"{space.title}, {1e3 * space.noise_m_s2:g} mm/s^2 per axis"
        headings = ("placement", "alpha_x", "alpha_y", "alpha_z", "vector (rad/s^2)", "tip (mm/s^2)")
        table = table_of(title, *headings)
        rows = (best.placement, micron_004(), micron_004_turned(), cube_004(), proposed_004())
        for p in rows:
            noise = angular_noise(p, space.noise_m_s2)
            at_tip = 1e3 * float(np.linalg.norm(point_noise(p, space.noise_m_s2, tip)))
            name = p.name if p is best.placement else f"{p.name} (Latt 2011)"
            table.add_row(name, *(f"{v:.3f}" for v in noise), f"{at_tip:.1f}")
        data_console().print(table)
        for i, (r, s) in enumerate(zip(best.placement.positions * 1e3, best.placement.axes, strict=True)):
            data_console().print(
                f"axis {i + 1}: at ({r[0]:.2f}, {r[1]:.2f}, {r[2]:.2f}) mm, "
                f"direction ({s[0]:.3f}, {s[1]:.3f}, {s[2]:.3f})"
            )
        checks = check_pairs(best.placement)
        for p in rows:
            for line in verdicts(p):
                data_console().print(line, highlight=False)
        save_placement_picture(best.placement, space, image)
        console().print(f"picture: {image}")
        write_json(
            {
                "format": 1,
                "positions_m": best.placement.positions,
                "axes": best.placement.axes,
                "noise_rad_s2": best.noise,
                "boxes": best.boxes,
                "propositions": [asdict(check) for check in checks],
            },
            json_file,
        )
