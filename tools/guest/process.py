"""Runs the process of a guest: ``python -m tools.guest.process`` answers its host until standard input ends.

It limits itself before the guest's first line runs: memory, core dumps, death with the host. What the guest prints goes
to standard error; only this file writes to the pipe.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from hal.arrays import Array
from tools.guest.frames import SIZES_BYTES, frame_parts, read_parts, read_sizes

Answer = tuple[dict[str, Any], dict[str, Array]]
PR_SET_PDEATHSIG = 1


def limit_process(memory_bytes: int) -> None:
    """Limit this process. What the system does not offer is left out (macOS has no limit on data)."""
    import resource

    for kind, most in (("RLIMIT_DATA", memory_bytes), ("RLIMIT_CORE", 0)):
        try:
            resource.setrlimit(getattr(resource, kind), (most, most))
        except (ValueError, OSError):
            continue
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the host decides what Ctrl-C ends
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def loaded_module(path: str, source: str) -> types.ModuleType:
    """Return the module that the text ``source`` of the file ``path`` makes."""
    module = types.ModuleType(Path(path).stem)
    module.__file__ = path
    sys.modules[module.__name__] = module
    exec(compile(source, path, "exec"), module.__dict__)
    return module


class Guest:
    """The program that the host has opened; there is one per process."""

    def __init__(self) -> None:
        self._run: Callable[[Mapping[str, Array], Mapping[str, Any]], Mapping[str, Array]] | None = None

    def answer(self, head: dict[str, Any], arrays: dict[str, Array]) -> Answer:
        """Do what one message asks."""
        match head["ask"]:
            case "trace":
                return self._trace(head)
            case "open_fmu":
                return self._open_fmu(head)
            case "open_module":
                self._run = self._module(head)
                return {}, {}
            case "open_entry":
                self._run = self._entry(head)
                return {}, {}
            case "run":
                assert self._run is not None
                found = self._run(arrays, head["parameters"])
                if not isinstance(found, Mapping):
                    raise TypeError(f"it returned a {type(found).__name__}, not outputs by name")
                out = {str(name): np.asarray(y, np.float64) for name, y in found.items()}
                return {"shapes": {name: list(y.shape) for name, y in out.items()}}, out
            case other:
                raise ValueError(f"unknown request {other}")

    def _trace(self, head: dict[str, Any]) -> Answer:
        from tools.guest.equations import Builder, trace

        function = getattr(loaded_module(head["path"], head["source"]), head["attribute"], None)
        if not callable(function):
            raise AttributeError(f"it has no function '{head['attribute']}'")
        builder = Builder(tuple(head["names"]))
        results = trace(builder, function, head["groups"])
        return {"operations": builder.operations, "results": results}, {"registers": np.array(builder.values)}

    def _open_fmu(self, head: dict[str, Any]) -> Answer:
        from tools.guest.fmu import OpenFmu

        fmu = OpenFmu(Path(head["path"]), head["digest"], tuple(head["outputs"]), head["dt"])
        self._run = fmu
        linear = fmu.linear(list(head["inputs"]), head["start"])
        return {"names": sorted(fmu.names()), "kind": fmu.kind, "linear": linear}, {}

    def _module(self, head: dict[str, Any]) -> Callable[..., Mapping[str, Array]]:
        simulate = getattr(loaded_module(head["path"], head["source"]), "simulate", None)
        if not callable(simulate):
            raise AttributeError("it has no simulate(inputs, parameters, dt)")
        dt = float(head["dt"])
        return lambda inputs, _: simulate(inputs, dt=dt)  # pyright: ignore[reportReturnType]

    def _entry(self, head: dict[str, Any]) -> Callable[..., Mapping[str, Array]]:
        from importlib.metadata import EntryPoint

        sys.path[:] = [*sys.path, *(p for p in head["import_path"] if p and p not in sys.path)]
        loaded: Any = EntryPoint(head["name"], head["value"], head["group"]).load()
        thing = loaded() if isinstance(loaded, type) else loaded
        if not callable(getattr(thing, "simulate", None)):
            raise AttributeError("it has no simulate(inputs, parameters)")
        return thing.simulate  # pyright: ignore[reportReturnType, reportUnknownMemberType]


def _read_exactly(pipe: BinaryIO, size: int) -> bytes:
    data = pipe.read(size)
    if len(data) < size:
        raise SystemExit(0)  # the host is gone
    return data


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer until the requests end. Whatever a guest raises becomes an answer."""
    guest = Guest()
    while True:
        head_bytes, body_bytes = read_sizes(_read_exactly(requests, SIZES_BYTES))
        head, arrays = read_parts(_read_exactly(requests, head_bytes), _read_exactly(requests, body_bytes))
        try:
            reply, out = guest.answer(head, arrays)
        except MemoryError:
            reply, out = {"error": "MemoryError", "message": "no memory is left below its limit"}, {}
        except Exception as error:
            reply, out = {"error": type(error).__name__, "message": " ".join(str(error).split())[:500]}, {}
        for part in frame_parts(reply, out):
            answers.write(part)
        answers.flush()


def main() -> None:
    """Set the limits and serve."""
    limit_process(int(sys.argv[1]))
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of a guest must not get between the answers
    serve(os.fdopen(os.dup(0), "rb"), answers)


if __name__ == "__main__":
    main()
