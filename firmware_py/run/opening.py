"""Probes devices one after the other and reports every one that did not answer, not only the first."""

from __future__ import annotations

from collections.abc import Callable

from hal.errors import HalError, OpenFailed


class Probes:
    """Collects the answers of the devices' probes in ``identities``, and the errors of those that do not answer."""

    def __init__(self) -> None:
        self.identities: dict[str, str] = {}
        self._failures: list[HalError] = []

    def probe(self, name: str, ask: Callable[[], str]) -> None:
        """Keep the answer of ``ask`` under ``name``, or its error."""
        try:
            self.identities[name] = ask()
        except HalError as error:
            self._failures.append(error)

    def raise_failures(self) -> None:
        """Raise the one error, or ``OpenFailed`` with all of them; return if there is none."""
        if self._failures:
            raise self._failures[0] if len(self._failures) == 1 else OpenFailed(self._failures)
