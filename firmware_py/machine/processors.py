"""Lists of processors, as the kernel writes them: ``0-2,5``."""

from __future__ import annotations


def parse_processors(text: str | None) -> list[int]:
    """Return the numbers of a list of the kernel, sorted; none for an empty list, ``(null)`` or other text."""
    numbers: set[int] = set()
    for part in (text or "").split(","):
        first, _, last = part.strip().partition("-")
        if first.isdigit() and (last.isdigit() or not last):
            numbers.update(range(int(first), int(last or first) + 1))
    return sorted(numbers)


def format_processors(numbers: list[int]) -> str:
    """Return the kernel's list of sorted ``numbers``."""
    spans: list[list[int]] = []
    for number in numbers:
        if spans and number == spans[-1][1] + 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    return ",".join(str(a) if a == b else f"{a}-{b}" for a, b in spans)
