"""Fig. 6.7: the workspace of the tip beside the tremor's sphere."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from firmware_py.actuation.config import ActuationConfig
from tools.output import save_figure
from tools.research.manipulator.workspace import Workspace, border_faces

TREMOR_UM = 50.0


def save_workspace_picture(config: ActuationConfig, workspace: Workspace, path: Path) -> None:
    """PNG: the whole workspace, and a section through x and z at the same scale for both axes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    faces = [face * 1e6 for face in border_faces(config)]
    figure = Figure(figsize=(12.0, 5.6), layout="constrained")
    space = figure.add_subplot(1, 2, 1, projection="3d")
    for face in faces:
        space.plot_surface(face[..., 0], face[..., 1], face[..., 2], color="tab:blue", alpha=0.12, linewidth=0.0)
        space.plot_wireframe(
            face[..., 0], face[..., 1], face[..., 2], rstride=11, cstride=11, color="tab:blue", linewidth=0.6
        )
    u, v = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 25), np.linspace(0.0, np.pi, 13))
    ball = 0.5 * TREMOR_UM * np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
    space.plot_surface(*ball, color="tab:red")
    space.set_xlabel("x (um)")
    space.set_ylabel("y (um)")
    space.set_zlabel("z (um)")
    space.set_title(
        "workspace {:.0f} x {:.0f} x {:.0f} um, z drawn larger".format(*(workspace.extent_m * 1e6)), fontsize=10
    )
    flat = figure.add_subplot(1, 2, 2)
    cloud = np.concatenate([face.reshape(-1, 3) for face in faces])
    flat.plot(cloud[:, 0], cloud[:, 2], ",", color="tab:blue")
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    for radius, at, colour, name in (
        (0.5 * TREMOR_UM, np.zeros(3), "tab:red", "tremor, 50 um"),
        (0.5e6 * workspace.sphere_m, workspace.sphere_at_m * 1e6, "tab:green", "largest sphere"),
    ):
        label = f"{name}: diameter {2.0 * radius:.0f} um"
        flat.plot(at[0] + radius * np.cos(turn), at[2] + radius * np.sin(turn), color=colour, label=label)
    flat.set_aspect("equal")
    flat.set_xlabel("x (um)")
    flat.set_ylabel("z (um)")
    flat.set_title("seen along y, to scale", fontsize=10, loc="right")
    flat.legend(loc="upper center", bbox_to_anchor=(0.5, -0.9), fontsize=9)
    save_figure(figure, path, dpi=110)
