"""A made-up stack on disk: small recordings of one system, with waveforms that differ by seed."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.recording_text import stack_channels

RATE_HZ = 100.0
NOISE_UM = 0.01
Change = Callable[[np.ndarray, np.ndarray], np.ndarray]

TWIN = 'kind = "piezo_stack"\n[twin.parameters]\ngain_um_per_V = 0.125\noffset_um = -1.0\n'

CHANNELS = stack_channels("u", "z", NOISE_UM)


def recording(folder: Path, *, change: Change, seed: int = 1, samples: int = 1500, twin: str = TWIN) -> Path:
    """Write one; ``change(u, t)`` is what the stack really does with the command u (V), in um."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) / RATE_HZ
    frequencies, phases = rng.uniform(0.1, 2.0, 5), rng.uniform(0, 6.28, 5)
    u = 50 + np.sum([9 * np.sin(2 * np.pi * f * t + p) for f, p in zip(frequencies, phases, strict=True)], axis=0)
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "data.npz", u=u, z=change(u, t) + rng.normal(0, NOISE_UM, samples))
    text = f'format = 1\ntitle = "stack"\ndata = "data.npz"\nrate_hz = {RATE_HZ}\n\n[twin]\n{twin}{CHANNELS}'
    (folder / "recording.toml").write_text(text)
    return folder / "recording.toml"
