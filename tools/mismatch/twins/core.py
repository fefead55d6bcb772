"""Builds a twin from the ``[twin]`` table, without the effects of a corrected one."""

from __future__ import annotations

from tools.errors import RecordingError
from tools.mismatch.recording import Recording
from tools.mismatch.twins.axis import axis_twin
from tools.mismatch.twins.base import Twin
from tools.mismatch.twins.cascade import cascade_twin
from tools.mismatch.twins.cluster import cluster_twin
from tools.mismatch.twins.columns import columns_twin
from tools.mismatch.twins.fmu import fmu_twin, with_equations
from tools.mismatch.twins.ode_matrices import physical_twin
from tools.mismatch.twins.ode_text import ode_twin
from tools.mismatch.twins.opaque import function_twin, user_twin
from tools.mismatch.twins.state_space import read_matrices, state_space_twin
from tools.mismatch.twins.static import static_twin
from tools.mismatch.twins.vocabulary import find_user_kind


def core(recording: Recording) -> Twin:
    """Build the twin without effects, which ``simulate_text.restore`` adds.

    Raises RecordingError for unknown kinds and parameters.
    """
    kind = recording.twin.kind
    if recording.twin.simulate is not None:
        return function_twin(recording, recording.twin.simulate)
    match kind:
        case "piezo_stack" | "accelerometer" | "magnetometer":
            return static_twin(recording)
        case "accelerometer_cluster":
            return cluster_twin(recording)
        case "mechanical_axis":
            return axis_twin(recording)
        case "state_space":
            if "states" in recording.twin.parameters:
                return physical_twin(recording, read_matrices(recording))
            if "first" in recording.twin.parameters:
                return cascade_twin(recording, state_space_twin)
            return state_space_twin(recording)
        case "columns":
            return columns_twin(recording)
        case "ode":
            return ode_twin(recording)
        case "fmu":
            known = with_equations(recording)
            return fmu_twin(recording) if known is recording else core(known)
        case "instrument":
            from tools.mismatch.twins.instrument import instrument_twin

            return instrument_twin(recording)
        case _:
            entry = find_user_kind(kind)
            if entry is None:
                raise RecordingError(f"{recording.path}: [twin] kind '{kind}' is unknown")
            return user_twin(recording, entry)
