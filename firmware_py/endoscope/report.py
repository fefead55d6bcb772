"""Builds the targeting experiment's report for each user: elapsed time, clicks, rotations (Erat 2018, sections 6.1,
6.3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from firmware_py.endoscope.targets import TargetGame


def experiment(game: TargetGame) -> dict[str, Any]:
    """Return settings, totals and one row per target reached. Angles in degrees, times in seconds, sizes in pixels.

    ``mean_rotation_deg``: mean over all activations of the largest |psi| and |theta| of each, as Figure 6.9 has it.
    """
    config = game.config
    return {
        "mapping": config.control.mapping,
        "gain": config.control.gain,
        "response_s": config.control.response_s,
        "tolerance_px": config.tolerance_px,
        "seed": config.seed,
        "done": game.done,
        "targets": config.targets,
        "reached": len(game.results),
        "elapsed_s": sum(r.elapsed_s for r in game.results),
        "clicks": sum(r.clicks for r in game.results),
        "mean_rotation_deg": list(_mean_rotation([r for result in game.results for r in result.rotations_deg])),
        "rows": [
            {
                "target": i + 1,
                "elapsed_s": result.elapsed_s,
                "clicks": result.clicks,
                "psi_min_deg": result.psi_deg[0],
                "psi_max_deg": result.psi_deg[1],
                "theta_min_deg": result.theta_deg[0],
                "theta_max_deg": result.theta_deg[1],
                "activations": len(result.rotations_deg),
            }
            for i, result in enumerate(game.results)
        ],
    }


def _mean_rotation(rotations: Sequence[tuple[float, float]]) -> tuple[float, float]:
    n = max(1, len(rotations))
    return sum(r[0] for r in rotations) / n, sum(r[1] for r in rotations) / n


def report_csv(user: str, result: dict[str, Any]) -> str:
    """Return the report file of one user: a header of settings as comments, then a row per target."""
    head = [f"# user {' '.join(user.split())}"]
    head += [f"# {key} {result[key]}" for key in ("mapping", "gain", "response_s", "tolerance_px", "seed", "done")]
    head += [f"# elapsed_s {result['elapsed_s']:.2f}", f"# clicks {result['clicks']}"]
    psi, theta = result["mean_rotation_deg"]
    head.append(f"# mean_rotation_deg {psi:.2f} {theta:.2f}")
    columns = ("target", "elapsed_s", "clicks", "psi_min_deg", "psi_max_deg", "theta_min_deg", "theta_max_deg")
    lines = [",".join(columns)]
    for row in result["rows"]:
        lines.append(",".join(f"{row[c]:.2f}" if isinstance(row[c], float) else str(row[c]) for c in columns))
    return "\n".join([*head, *lines]) + "\n"
