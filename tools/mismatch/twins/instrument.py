"""The whole emulated bench as a twin: the bench's own program, run on the recorded hand motion."""

from __future__ import annotations

from tools.mismatch.recording import Recording, RecordingError
from tools.mismatch.twins.opaque import OpaqueTwin


def instrument_twin(recording: Recording) -> OpaqueTwin:
    """The bench that ``[twin.parameters] bench`` names. Raises RecordingError while no bench runs as a twin."""
    bench = recording.twin.parameters.get("bench")
    if not isinstance(bench, str):
        raise RecordingError(f"{recording.path}: [twin.parameters] bench must name the bench file, got {bench!r}")
    raise RecordingError(f"{recording.path}: [twin] kind 'instrument' is not available in this build")
